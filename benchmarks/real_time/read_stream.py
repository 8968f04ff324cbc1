"""Reads what the page in the browser is sent, and throws it away: `read_stream.py ADDRESS`.

Says so with an event once it is served.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import signal
import sys

from aiohttp import ClientConnectionError, ClientSession, ClientTimeout

AGAIN_S = 0.02


async def read(address: str) -> None:
    """Read as soon as somebody serves it."""
    async with ClientSession(timeout=ClientTimeout(total=None)) as session:
        while True:
            with contextlib.suppress(ClientConnectionError):
                async with session.get(f'{address}/events') as response:
                    print(json.dumps({'event': 'ready'}), flush=True)
                    async for _ in response.content.iter_any():
                        pass
                    return
            await asyncio.sleep(AGAIN_S)


if __name__ == '__main__':
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):
        asyncio.run(read(sys.argv[1]))
