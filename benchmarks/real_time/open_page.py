"""Keeps a page open in a headless Chromium until it is stopped: `open_page.py ADDRESS`.

Says so with an event once the page is served.
"""

from __future__ import annotations

import asyncio
import json
import signal
import sys
from pathlib import Path

sys.path.append(str(Path(__file__).resolve().parents[2] / 'docs' / 'made_by'))

from aiohttp import ClientConnectionError, ClientSession
from browser import LOOK_S, chromium


async def keep_open(address: str) -> None:
    """Open the page as soon as somebody serves it."""
    stopped = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stopped.set)
    async with ClientSession() as session:
        while not stopped.is_set():
            try:
                async with session.get(address):
                    break
            except ClientConnectionError:
                await asyncio.sleep(LOOK_S)
    async with chromium() as browser, browser.open(address) as tab:
        await tab.wait_until("document.getElementById('connection').textContent === 'live'")
        print(json.dumps({'event': 'ready'}), flush=True)
        await stopped.wait()


if __name__ == '__main__':
    asyncio.run(keep_open(sys.argv[1]))
