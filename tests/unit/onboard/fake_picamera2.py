"""Stands in for the package picamera2: a camera that shows one scene and names its formats backwards."""

from __future__ import annotations

import threading
import time
import types
from concurrent.futures import Future

import numpy as np

#: What the camera looks at: a pixel that is mostly red, in blue, green, red.
BLUE, GREEN, RED = 10, 60, 200
#: Bytes of a pixel in memory, as the manual's table of formats has them.
MEMORY = {
    "RGB888": (BLUE, GREEN, RED),
    "BGR888": (RED, GREEN, BLUE),
    "XRGB8888": (BLUE, GREEN, RED, 255),
    "XBGR8888": (RED, GREEN, BLUE, 255),
}


class Request:
    def __init__(self, camera, stamp_ns):
        self.camera, self.stamp_ns = camera, stamp_ns

    def make_array(self, name):
        assert name == "main"
        width, height = self.camera.config["main"]["size"]
        image = np.empty((height, width, len(MEMORY[self.camera.format])), np.uint8)
        image[:] = MEMORY[self.camera.format]
        return image

    def get_metadata(self):
        return {} if self.stamp_ns is None else {"SensorTimestamp": self.stamp_ns, "ExposureTime": 5000}

    def release(self):
        self.camera.world.held -= 1


class Job:
    def __init__(self):
        self.future = Future()

    def get_result(self, timeout=None):
        return self.future.result(timeout)


class OldJob(Job):
    """Of picamera2 0.3.12 to 0.3.16: nobody can wait for it with a limit (its change log, 0.3.17)."""

    def get_result(self):
        return self.future.result()


class Camera:
    def __init__(self, world, number):
        if number >= world.cameras:
            raise IndexError("list index out of range")
        self.world, self.jobs, self.running = world, [], False
        world.opened += 1

    def create_video_configuration(self, main, controls, buffer_count):
        return {"main": dict(main), "controls": controls, "buffer_count": buffer_count}

    def configure(self, config):
        self.config = config
        self.format = self.world.forced_format or config["main"]["format"]
        config["main"]["format"] = self.format

    def camera_configuration(self):
        return self.config

    def start(self):
        self.running = True
        self.thread = threading.Thread(target=self._run, daemon=True)
        self.thread.start()

    def _run(self):
        while self.running:
            time.sleep(1 / self.config["controls"]["FrameRate"])
            if self.world.lost:
                continue
            exposed_ns = time.monotonic_ns() - self.world.age_ns if self.world.stamps else None
            jobs, self.jobs = self.jobs, []
            for job in jobs:
                self.world.held += 1
                job.future.set_result(Request(self, exposed_ns))

    def capture_request(self, wait=None):
        assert wait is False
        job = OldJob() if self.world.old else Job()
        self.world.most_jobs = max(self.world.most_jobs, len(self.jobs) + 1)
        self.jobs.append(job)
        return job

    def stop(self):
        self.running = False
        self.thread.join()

    def close(self):
        self.world.opened -= 1


class World:
    """What the tests set and look at."""

    def __init__(self):
        self.cameras, self.opened, self.held, self.most_jobs = 1, 0, 0, 0
        self.lost = self.old = False
        self.stamps, self.age_ns = True, 12_000_000
        self.forced_format = None


def install(monkeypatch):
    world = World()
    module = types.ModuleType("picamera2")
    module.Picamera2 = lambda number: Camera(world, number)
    monkeypatch.setitem(__import__("sys").modules, "picamera2", module)
    return world
