"""`python -m benchmarks.connectivity.hub HOST PORT`: a server of rosbridge's protocol between its clients.

As rosbridge_server, it reads each message, makes a value of it (base64 to bytes), and writes it anew for every subscriber.
It leaves out what ROS does in between, so it is faster than the real one.
"""

from __future__ import annotations

import asyncio
import base64
import json
import sys
from collections import defaultdict
from typing import Any


async def serve(host: str, port: int) -> None:
    """Until it is killed."""
    from websockets.asyncio.server import serve

    subscribers: defaultdict[str, set[Any]] = defaultdict(set)

    async def talk(client: Any) -> None:
        async for text in client:
            said = json.loads(text)
            topic = said["topic"]
            if said["op"] == "subscribe":
                subscribers[topic].add(client)
                continue
            value = base64.b64decode(said["msg"]["data"])
            for each in subscribers[topic]:
                message = {"op": "publish", "topic": topic, "msg": {"data": base64.b64encode(value).decode()}}
                await each.send(json.dumps(message))

    async with serve(talk, host, port, max_size=None, compression=None):
        print("up", flush=True)
        await asyncio.get_running_loop().create_future()


if __name__ == "__main__":
    asyncio.run(serve(sys.argv[1], int(sys.argv[2])))
