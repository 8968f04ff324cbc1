"""Takes the picture of the page in the browser: `.venv/bin/python docs/made_by/live_picture.py`.

It needs Chromium (`apt-get install chromium`), and so is no part of `make docs`.
"""

from __future__ import annotations

import argparse
import asyncio
import re
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from browser import chromium

PICTURE = Path(__file__).resolve().parents[1] / 'images' / 'live.png'
ADDRESS = re.compile(r'^live: (http://\S+)$')
WIDTH, HEIGHT = 1280, 800
AFTERWARDS_S = 6.0  # so that the curves still show how the backlash was learned
PATIENCE_S = 60.0
RUN = (
    sys.executable, '-m', 'backlash_ros.tools.bringup', '--config', 'geared_motor.yaml',
    '--duration', 'inf', '--no-record', '--live',
    # All of it four times as slow, for machines that have other work, and a swing of a few gaps.
    '--set', 'sample_period=0.02', '--set', 'frequency=0.8', '--set', 'amplitude=0.3',
    '--set', 'inverse.take_up_rate=25.0', '--set', 'control.rate_max=75.0',
)


async def picture(address: str, scheme: str) -> bytes:
    """The page as it is once the backlash has been known for a while."""
    async with chromium() as browser, browser.open(address) as tab:
        await tab.wait_until("document.getElementById('word').textContent.endsWith('tracking')")
        await asyncio.sleep(AFTERWARDS_S)
        # A machine that is held up is not what the page is about.
        await tab.wait_until(
            "document.getElementById('word').className === 'level0'", PATIENCE_S
        )
        return await tab.picture(WIDTH, HEIGHT, scheme)


def main() -> None:
    """Run the loop, and take the picture."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--out', type=Path, default=PICTURE, metavar='FILE')
    parser.add_argument('--scheme', choices=('light', 'dark'), default='light')
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        run = subprocess.Popen([*RUN, '--out', folder], stdout=subprocess.PIPE, text=True)
        assert run.stdout is not None
        try:
            address = next(found[1] for line in run.stdout if (found := ADDRESS.match(line)))
            taken = asyncio.run(picture(address, options.scheme))
        finally:
            run.send_signal(signal.SIGINT)
            run.communicate()
    options.out.write_bytes(taken)


if __name__ == '__main__':
    main()
