from __future__ import annotations

import os
import stat
import sys
import threading
import time
from pathlib import Path

import cv2
import fake_picamera2
import numpy as np
import pytest

from lanenet.config import check_settings
from lanenet.errors import ConfigError, HardwareError, MissingExtraError
from lanenet.onboard.cameras import open_source
from lanenet.onboard.cameras.live import CameraSettings, Capture, LiveSource
from lanenet.onboard.cameras.picamera import PiCameraSettings
from lanenet.onboard.cameras.rpicam import RpicamSettings
from lanenet.onboard.cameras.v4l2 import V4L2Settings
from lanenet.onboard.devices import FrameSource

ROOT = Path(__file__).resolve().parents[3]
SMALL = {"width": 64, "height": 48, "rate_hz": 100.0}


def read(source, timeout_s=2.0):
    frame = source.read(timeout_s)
    assert frame is not None, "no frame in time"
    return frame


class FakeDevice:
    """Images whose value counts up; ``lost`` makes it fail until ``starts`` has grown by ``needed``."""

    name = "fake camera"

    def __init__(self, rate_hz=200.0):
        self.rate_hz = rate_hz
        self.value = self.starts = self.stops = 0
        self.lost = self.silent = self.refuses = False
        self.shape = (48, 64, 3)
        self.threads = set()

    def start(self):
        self.starts += 1
        if self.refuses:
            raise HardwareError("fake camera: not there")

    def grab(self, timeout_s):
        self.threads.add(threading.get_ident())
        if self.lost:
            raise OSError("unplugged")
        if self.silent:
            time.sleep(timeout_s)
            return None
        time.sleep(1 / self.rate_hz)
        image = np.full(self.shape, self.value % 250, np.uint8)
        image[0, 0] = 255
        self.value += 1
        return Capture(image, skipped=1 if self.value % 10 == 0 else 0)

    def stop(self):
        self.stops += 1


@pytest.fixture
def device():
    return FakeDevice()


@pytest.fixture
def source(device):
    source = LiveSource(device, CameraSettings(width=64, height=48, silence_s=0.15, give_up_s=1.5))
    yield source
    source.close()


def test_only_the_newest_frame_is_kept(device, source):
    assert isinstance(source, FrameSource)
    source.open()
    first = read(source)
    time.sleep(0.2)
    second = read(source)
    assert second.number > first.number + 5, "frames that nobody read were kept"
    # The number counts what the device itself dropped, too.
    assert second.number == second.image_bgr[1, 1, 0] + (int(second.image_bgr[1, 1, 0]) + 1) // 10
    assert second.t_s > first.t_s
    assert time.monotonic() - second.t_s < 0.5


def test_no_frame_is_returned_twice(device, source):
    source.open()
    numbers = [read(source).number for _ in range(30)]
    assert sorted(set(numbers)) == numbers


def test_late_frame_is_none_after_the_timeout(device, source):
    source.open()
    read(source)
    device.silent = True
    time.sleep(0.03)
    source.read(0.0)
    start_s = time.monotonic()
    assert source.read(0.05) is None
    assert 0.045 < time.monotonic() - start_s < 0.4


def test_lost_camera_is_found_again(device, source, caplog):
    source.open()
    before = read(source).number
    device.lost = device.refuses = True
    time.sleep(0.1)
    source.read(0.0)
    assert source.read(0.3) is None
    device.lost = device.refuses = False
    assert read(source).number > before
    assert "camera lost: unplugged" in caplog.text and "starts again" in caplog.text
    assert device.starts >= 3, "it was not tried several times"


def test_silent_camera_counts_as_lost(device, source):
    source.open()
    device.silent = True
    time.sleep(0.5)
    assert device.starts > 1
    device.silent = False
    read(source)


def test_camera_gone_for_good_is_an_error(device):
    source = LiveSource(device, CameraSettings(width=64, height=48, give_up_s=0.3))
    source.open()
    device.lost = device.refuses = True
    with pytest.raises(HardwareError, match=r"fake camera: lost for 0\.3 s \(unplugged\)"):
        for _ in range(40):
            source.read(0.1)
    source.close()


@pytest.mark.parametrize("comes_back", ["as another camera", "with a driver that raises anything"])
def test_camera_that_comes_back_of_no_use_is_given_up(device, comes_back):
    source = LiveSource(device, CameraSettings(width=64, height=48, give_up_s=0.6))
    source.open()
    if comes_back == "as another camera":
        device.shape = (50, 64, 3)
    else:
        device.lost, device.start = True, lambda: 1 / 0
    with pytest.raises(HardwareError, match=r"fake camera: lost for 0\.6 s"):
        for _ in range(60):
            source.read(0.1)
    assert device.starts < 8
    source.close()


def test_open_refuses_what_does_not_work(device):
    settings = CameraSettings(width=64, height=48, start_s=0.2)
    device.silent = True
    with pytest.raises(HardwareError, match=r"no frame within 0\.2 s"):
        LiveSource(device, settings).open()
    device.silent, device.shape = False, (50, 64, 3)
    with pytest.raises(HardwareError, match=r"sends images of 64x50 px, expected 64x48"):
        LiveSource(device, settings).open()
    assert device.stops == 2
    with pytest.raises(HardwareError, match="not open"):
        LiveSource(device, settings).read(0.0)


@pytest.mark.parametrize("where", ["start", "grab"])
@pytest.mark.parametrize(
    "raised", [RuntimeError("busy"), TypeError("no timeout"), OSError(5, "lost"), KeyError()]
)
def test_whatever_a_driver_raises_at_the_first_frame_is_one_line(device, where, raised):
    def fails(*_):
        raise raised

    setattr(device, where, fails)
    source = LiveSource(device, CameraSettings(width=64, height=48))
    with pytest.raises(HardwareError) as caught:
        source.open()
    assert str(caught.value).startswith("fake camera: its driver fails at the first frame")
    assert type(raised).__name__ in str(caught.value) and "\n" not in str(caught.value)
    assert device.stops == 1


def test_a_first_frame_that_is_interrupted_is_not_the_cameras_fault(device):
    def interrupted(_):
        raise KeyboardInterrupt

    device.grab = interrupted
    with pytest.raises(KeyboardInterrupt):
        LiveSource(device, CameraSettings(width=64, height=48)).open()
    assert device.stops == 1


def test_turned_image(device):
    source = LiveSource(device, CameraSettings(width=64, height=48, rotate_180=True))
    source.open()
    image = read(source).image_bgr
    assert (image[-1, -1] == 255).all() and not (image[0, 0] == 255).any()
    source.close()


def test_close_stops_device_and_thread(device, source):
    source.open()
    threads = threading.active_count()
    source.close()
    source.close()
    assert threading.active_count() == threads - 1 and device.stops == 1
    value = device.value
    time.sleep(0.05)
    assert device.value == value
    source.open()
    read(source)


# --- picamera2


@pytest.fixture
def pi(monkeypatch):
    return fake_picamera2.install(monkeypatch)


@pytest.mark.parametrize("pixel_format", ["RGB888", "BGR888", "XRGB8888", "XBGR8888"])
def test_formats_named_backwards_come_out_as_bgr(pi, pixel_format):
    source = open_source(PiCameraSettings(pixel_format=pixel_format, **SMALL))
    source.open()
    image = read(source).image_bgr
    source.close()
    assert image.shape == (48, 64, 3) and image.flags.c_contiguous
    assert image[7, 9].tolist() == [fake_picamera2.BLUE, fake_picamera2.GREEN, fake_picamera2.RED]


def test_format_that_the_driver_chose_counts(pi):
    pi.forced_format = "XBGR8888"
    source = open_source(PiCameraSettings(**SMALL))
    source.open()
    assert read(source).image_bgr[0, 0].tolist() == [10, 60, 200]
    source.close()
    pi.forced_format = "YUV420"
    with pytest.raises(HardwareError, match="sends format 'YUV420', expected one of RGB888"):
        open_source(PiCameraSettings(**SMALL)).open()
    assert pi.opened == 0


def test_time_is_the_sensors(pi):
    source = open_source(PiCameraSettings(**SMALL))
    source.open()
    time.sleep(0.05)
    frame = read(source)
    late_s = time.monotonic() - frame.t_s
    assert 0.012 <= late_s < 0.5, "the sensor's time is 12 ms before the frame arrives"
    pi.age_ns = 5_000_000_000
    source.read(0.1)
    time.sleep(0.05)
    assert time.monotonic() - read(source).t_s > 4.9, "an image that was held up for 5 s counts as new"
    pi.stamps = False
    source.read(0.1)
    time.sleep(0.05)
    assert abs(time.monotonic() - read(source).t_s) < 0.5
    source.close()
    assert pi.held == 0, "requests were not given back"


def test_time_of_another_clock_is_not_used(pi):
    pi.age_ns = 3_600_000_000_000
    source = open_source(PiCameraSettings(**SMALL))
    source.open()
    time.sleep(0.05)
    assert abs(time.monotonic() - read(source).t_s) < 0.5
    pi.age_ns = -3_600_000_000_000
    source.read(0.1)
    time.sleep(0.05)
    assert abs(time.monotonic() - read(source).t_s) < 0.5
    source.close()


def test_picamera2_that_is_too_old_says_so(pi):
    pi.old = True
    with pytest.raises(HardwareError, match=r"picamera2 is too old, expected 0\.3\.17.*sudo apt upgrade"):
        open_source(PiCameraSettings(**SMALL)).open()
    assert pi.opened == 0


def test_late_camera_gets_no_pile_of_jobs(pi):
    settings = PiCameraSettings(silence_s=1.0, **SMALL)
    source = open_source(settings)
    source.open()
    pi.lost = True
    time.sleep(0.5)
    source.read(0.0)
    assert source.read(0.05) is None
    pi.lost = False
    read(source)
    source.close()
    assert pi.most_jobs == 1 and pi.opened == 0


def test_no_camera_and_no_package(pi, monkeypatch):
    with pytest.raises(HardwareError, match=r"picamera2 camera 3: cannot be started.*--list-cameras"):
        open_source(PiCameraSettings(camera=3, **SMALL)).open()
    monkeypatch.setitem(sys.modules, "picamera2", None)
    with pytest.raises(MissingExtraError, match=r"apt install python3-picamera2.*--system-site-packages"):
        open_source(PiCameraSettings(**SMALL)).open()


def test_numpy_that_does_not_fit_the_systems_modules(monkeypatch, tmp_path):
    (tmp_path / "picamera2.py").write_text("raise ValueError('numpy.dtype size changed')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "picamera2", raising=False)
    with pytest.raises(MissingExtraError, match=r"numpy\.dtype size changed.*pip install 'numpy<2'"):
        open_source(PiCameraSettings(**SMALL)).open()


# --- rpicam-vid

PROGRAM = """#!{python}
import sys, time
import cv2, numpy as np
def option(name):
    return sys.argv[sys.argv.index(name) + 1]
late_s = {late_s!r}
stamps = open(option("--metadata"), "w") if late_s is not None else None
open({log!r}, "a").write(" ".join(sys.argv[1:]) + "\\n")
w, h = int(option("--width")), int(option("--height"))
if option("--camera") == "5":
    sys.exit("ERROR: *** no cameras available ***")
for value in range({count}):
    image = np.full((h, w, 3), (value % 200, 90, 200 - value % 200), np.uint8)
    if option("--codec") == "mjpeg":
        data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
    else:
        data = cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420).tobytes()
    exposed_ns = 0 if late_s is None else time.monotonic_ns() - int(1e9 * late_s)
    # The pipe is filled in pieces that know nothing of images.
    for piece in (data[:100], data[100:101], data[101:]):
        sys.stdout.buffer.write(piece)
        sys.stdout.buffer.flush()
    if stamps is not None:
        for line in ("ExposureTime=5000", f"SensorTimestamp={{exposed_ns}}", "Lux=120.5", ""):
            print(line, file=stamps, flush=True)
    time.sleep(1 / float(option("--framerate")))
"""


@pytest.fixture
def program(tmp_path):
    def make(count=100000, late_s=0.03):
        path = tmp_path / "rpicam-vid"
        log = str(tmp_path / "log")
        path.write_text(PROGRAM.format(python=sys.executable, log=log, count=count, late_s=late_s))
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        return str(path)

    return make


@pytest.mark.parametrize("codec", ["mjpeg", "yuv420"])
def test_pipe_of_rpicam_vid(program, tmp_path, codec):
    settings = RpicamSettings(program=program(), codec=codec, options=("--shutter", "8000"), **SMALL)
    source = open_source(settings)
    source.open()
    first, later = read(source), None
    for _ in range(5):
        later = read(source)
    source.close()
    assert later.number > first.number and later.image_bgr.shape == (48, 64, 3)
    blue, green, red = later.image_bgr[20, 20].astype(int)
    assert (blue, green, red) == pytest.approx((later.number % 200, 90, 200 - later.number % 200), abs=4)
    words = (tmp_path / "log").read_text()
    assert "--nopreview --timeout 0" in words and "--shutter 8000" in words


@pytest.mark.parametrize("codec", ["mjpeg", "yuv420"])
@pytest.mark.parametrize("late_s", [0.03, 1.0])
def test_age_of_a_frame_is_what_rpicam_vid_says(program, late_s, codec):
    source = open_source(RpicamSettings(program=program(late_s=late_s), codec=codec, **SMALL))
    source.open()
    for _ in range(20):
        frame = read(source)
        assert frame.age_known
        # Each frame has its own time: they come every 10 ms, and some are not read.
        assert late_s - 0.001 <= time.monotonic() - frame.t_s < late_s + 0.5
    source.close()


def test_without_its_metadata_the_age_is_unknown(program, caplog):
    source = open_source(RpicamSettings(program=program(late_s=None), **SMALL))
    source.open()
    assert not read(source).age_known and not read(source).age_known
    source.close()
    assert "age of its frames is unknown: its driver gives no time of exposure" in caplog.text


def test_a_program_that_knows_no_metadata_is_not_asked(program, tmp_path):
    source = open_source(RpicamSettings(program=program(late_s=None), metadata=False, **SMALL))
    source.open()
    assert not read(source).age_known
    source.close()
    assert "--metadata" not in (tmp_path / "log").read_text()


def test_pipes_are_closed(program):
    before = len(os.listdir("/proc/self/fd"))
    for _ in range(3):
        source = open_source(RpicamSettings(program=program(), **SMALL))
        source.open()
        source.close()
    assert len(os.listdir("/proc/self/fd")) == before


def test_program_that_ends_is_started_again(program, tmp_path):
    source = open_source(RpicamSettings(program=program(count=5), **SMALL))
    source.open()
    end_s = time.monotonic() + 8.0
    while (tmp_path / "log").read_text().count("\n") < 2 and time.monotonic() < end_s:
        source.read(0.1)
    source.close()
    assert (tmp_path / "log").read_text().count("\n") >= 2


def test_what_the_program_says_is_shown(program):
    settings = RpicamSettings(program=program(), camera=5, **SMALL)
    with pytest.raises(HardwareError, match=r"the program ended: ERROR: .* no cameras available"):
        open_source(settings).open()
    with pytest.raises(HardwareError, match="cannot be run"):
        open_source(RpicamSettings(program="/nowhere/rpicam-vid", **SMALL)).open()


def test_neither_program_is_there(monkeypatch):
    monkeypatch.setattr("shutil.which", lambda name: None)
    with pytest.raises(HardwareError, match="apt install rpicam-apps"):
        open_source(RpicamSettings(**SMALL)).open()


def test_raw_images_need_a_width_without_padding():
    with pytest.raises(ConfigError, match=r"width=160 and height=120: .*multiple of 64"):
        check_settings(RpicamSettings, {"codec": "yuv420", "width": 160, "height": 120}, "car.yaml")


# --- V4L2


class FakeCapture:
    """``cv2.VideoCapture`` of a camera."""

    opened = True
    frames_left = 10**9
    clock = staticmethod(time.monotonic)

    def __init__(self, device, backend):
        assert backend == cv2.CAP_V4L2
        self.set_values = {}

    def isOpened(self):
        return FakeCapture.opened

    def set(self, key, value):
        self.set_values[key] = value

    def get(self, key):
        assert key == cv2.CAP_PROP_POS_MSEC
        return 1e3 * (FakeCapture.clock() - 0.02)

    def read(self):
        time.sleep(0.01)
        FakeCapture.frames_left -= 1
        if FakeCapture.frames_left < 0:
            return False, None
        size = self.set_values[cv2.CAP_PROP_FRAME_HEIGHT], self.set_values[cv2.CAP_PROP_FRAME_WIDTH]
        return True, np.full((*map(int, size), 3), 9, np.uint8)

    def release(self):
        pass


def test_usb_camera(monkeypatch):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    source = open_source(V4L2Settings(**SMALL))
    source.open()
    time.sleep(0.05)
    frame = read(source)
    assert 0.02 <= time.monotonic() - frame.t_s < 0.5, "the driver's time was not used"
    monkeypatch.setattr(FakeCapture, "frames_left", 0)
    time.sleep(0.05)
    source.read(0.0)
    assert source.read(0.05) is None
    monkeypatch.setattr(FakeCapture, "frames_left", 10**9)
    read(source)
    source.close()
    monkeypatch.setattr(FakeCapture, "opened", False)
    with pytest.raises(HardwareError, match="/dev/video0: cannot be opened"):
        open_source(V4L2Settings(**SMALL)).open()


class RawCapture(FakeCapture):
    """Gives the bytes of a JPEG image where OpenCV shall not convert; every other one lost some."""

    made = 0

    def read(self):
        ok, image = super().read()
        RawCapture.made += 1
        image = cv2.imread(str(ROOT / "checkpoints" / "small" / "example.jpg"))
        if self.set_values.get(cv2.CAP_PROP_CONVERT_RGB, 1):
            return ok, image
        if RawCapture.other:
            return ok, np.zeros((240, 320, 2), np.uint8)
        data = cv2.imencode(".jpg", image)[1].ravel()
        lost = data if RawCapture.made % 2 else np.delete(data, slice(4000, 4500))
        return ok, np.concatenate([lost, np.zeros(30, np.uint8)])[None]


@pytest.mark.parametrize("other", [False, True])
def test_usb_cameras_images_that_lost_bytes_are_none(monkeypatch, other):
    monkeypatch.setattr(cv2, "VideoCapture", RawCapture)
    monkeypatch.setattr(RawCapture, "other", other, raising=False)
    device = V4L2Settings().make_device()
    device.start()
    captures = [device.grab(0.1) for _ in range(10)]
    device.stop()
    whole = [capture for capture in captures if capture is not None]
    # A camera that sends another format than MJPG loses one frame, and OpenCV converts the others.
    assert len(whole) == (9 if other else 5)
    assert all(capture.image_bgr.shape == (240, 320, 3) and capture.image_bgr.std() > 20 for capture in whole)


@pytest.mark.parametrize("stamp_s", [0.0, 1.7e9])
def test_usb_camera_with_another_clock_has_none(monkeypatch, stamp_s):
    monkeypatch.setattr(cv2, "VideoCapture", FakeCapture)
    monkeypatch.setattr(FakeCapture, "clock", staticmethod(lambda: stamp_s + 0.02))
    source = open_source(V4L2Settings(**SMALL))
    source.open()
    frame = read(source)
    source.close()
    assert not frame.age_known and abs(time.monotonic() - frame.t_s) < 0.5


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"kind": "v4l2", "widht": 320}, "did you mean 'width'"),
        ({"kind": "v4l2", "rate_hz": 0}, "greater than 0"),
    ],
)
def test_settings_are_strict(data, message):
    with pytest.raises(ConfigError, match=message):
        check_settings(V4L2Settings, data, "car.yaml")
