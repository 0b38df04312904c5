"""Acts as the browser of Donkeycar's own page; for an environment with donkeycar.

python donkeycar_page.py CAR OUT

Starts ``manage.py drive`` in the folder CAR, sends what the page sends, and writes into OUT what came back:
``told.json``, and the last image of the stream in each step.
"""

from __future__ import annotations

import asyncio
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

from tornado.httpclient import AsyncHTTPClient, HTTPRequest
from tornado.websocket import websocket_connect

#: What the page sends, from its ``static/main.js``: the button that stops the car, joystick, recording, mode;
#: None closes the page.
STOP = {"angle": 0, "throttle": 0, "drive_mode": "user", "recording": False}
STEPS = (
    ("user", {"angle": 0.5, "throttle": 0.3}),
    ("record", {"recording": True}),
    ("stop", STOP),
    ("local_angle", {"drive_mode": "local_angle", "angle": 0, "throttle": 0.2, "recording": True}),
    ("local_angle at rest", {"throttle": 0}),
    ("local", {"drive_mode": "local"}),
    ("stop of the pilot", STOP),
    ("local again", {"drive_mode": "local"}),
    ("page closed", None),
)
STEP_S = 1.5


class Stream:
    """The last whole image of the motion JPEG stream."""

    def __init__(self) -> None:
        self.rest, self.jpeg, self.count = b"", b"", 0

    def take(self, chunk: bytes) -> None:
        self.rest += chunk
        while True:
            head, found, body = self.rest.partition(b"\r\n\r\n")
            if not found:
                return
            length = int(head.rpartition(b"Content-length: ")[2])
            if len(body) < length:
                return
            self.jpeg, self.rest, self.count = body[:length], body[length:], self.count + 1


async def until_it_answers(client: AsyncHTTPClient, url: str) -> str:
    for _ in range(300):
        try:
            return (await client.fetch(url)).body.decode()
        except OSError:
            await asyncio.sleep(0.1)
    raise TimeoutError(f"{url} does not answer")


async def browse(host: str, out: Path) -> dict:
    client = AsyncHTTPClient()
    page = await until_it_answers(client, f"http://{host}/")
    stream, heard = Stream(), []
    video = HTTPRequest(f"http://{host}/video", streaming_callback=stream.take, request_timeout=0.0)
    watching = asyncio.ensure_future(client.fetch(video, raise_error=False))
    connection = await websocket_connect(f"ws://{host}/wsDrive", on_message_callback=heard.append)
    steps = []
    for name, message in STEPS:
        begin_s = time.time()
        if message is None:
            connection.close()
        else:
            await connection.write_message(json.dumps(message))
        await asyncio.sleep(STEP_S)
        steps.append({"name": name, "begin_s": begin_s, "end_s": time.time(), "images": stream.count})
        (out / f"{name}.jpg").write_bytes(stream.jpeg)
    watching.cancel()
    return {"page": page, "steps": steps, "heard": [json.loads(text) for text in heard if text]}


def main(car: Path, out: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    words, environment = [sys.executable, "manage.py", "drive"], os.environ | {"WEB_CONTROL_PORT": str(port)}
    # A shell in the background lets its children ignore it, and the vehicle would never end.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with open(car / "log.txt", "w") as log:
        vehicle = subprocess.Popen(words, cwd=car, env=environment, stdout=log, stderr=log)
        try:
            told = asyncio.run(browse(f"127.0.0.1:{port}", out))
            vehicle.send_signal(signal.SIGINT)
            told["code"] = vehicle.wait(20)
        finally:
            vehicle.kill()
    (out / "told.json").write_text(json.dumps(told))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
