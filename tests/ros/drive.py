"""The bag as it is played to a node, and what is asked of what comes back."""
import time
from pathlib import Path

import numpy as np

from peer import diagnosis, read_bag, stamp_of

CAMERAS = 3
CLOUD, IMAGE, INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"
# Values of live and of replayed results may differ by this much.
TOLERANCE = 1e-4
OK, WARN, ERROR = 0, 1, 2
RELIABLE_INPUT = {"live.reliability": "reliable", "live.cameras": CAMERAS, "live.queue": 50}


class Drive:
    """The bag, ready to be played as often as wanted, each time with later stamps."""

    def __init__(self, bag: Path, topics=None):
        self.messages = [m for m in read_bag(bag) if not m.topic.startswith("/ground_truth")]
        if topics:
            self.messages = [m for m in self.messages if m.topic in topics]
        self.images = [f"/camera{i}/image" for i in range(CAMERAS)]

    def stamps(self) -> list[int]:
        return sorted({stamp_of(m.value().header) for m in self.messages if m.topic == self.images[0]})


def shifted(message, by_ns: int) -> bytes:
    """The message's bytes with a header stamp later by so much (CDR: 4 bytes of header, then sec and nanosec)."""
    data = bytearray(message.data)
    if message.topic not in ("/tf", "/tf_static"):
        stamp = int.from_bytes(data[4:8], "little", signed=True) * 10**9 + int.from_bytes(data[8:12], "little") + by_ns
        data[4:8] = (stamp // 10**9).to_bytes(4, "little", signed=True)
        data[8:12] = (stamp % 10**9).to_bytes(4, "little")
    return bytes(data)


def play(peer, drive, skip=lambda topic, t: False, by_ns=0, speed=1.0, seconds=None, each=None):
    """Plays the drive in its own time. `skip(topic, seconds since its start)` leaves messages out."""
    first = drive.messages[0].time_ns
    start = time.monotonic()
    for m in drive.messages:
        t = (m.time_ns - first) * 1e-9
        if seconds is not None and t > seconds:
            break
        delay = t / speed - (time.monotonic() - start)
        if delay > 0:
            time.sleep(delay)
        if each:
            each(t)
        if not skip(m.topic, t):
            peer.play(m, shifted(m, by_ns) if by_ns else None)


def running(peer, node, drive, listen=("gaussians",)):
    """Offers the drive's topics, waits for the node to subscribe; its outputs in `listen` are heard."""
    for name in listen:
        peer.listen(f"/storm/output/{name}", CLOUD)
    peer.listen("/diagnostics", DIAGNOSTICS)
    for m in drive.messages:
        if m.topic == "/tf_static":
            peer.play(m)
    node.says("pose: ")
    peer.matched({m.topic for m in drive.messages})


def newest(peer) -> dict:
    return diagnosis(peer.last("/diagnostics", DIAGNOSTICS)) if peer.count("/diagnostics") else {}


def ever(peer, part: str, level: int, text: str) -> bool:
    """Whether the diagnostics ever said so."""
    said = [diagnosis(d).get(part) for d in peer.messages("/diagnostics", DIAGNOSTICS)]
    return any(s and s[0] == level and text in s[1] for s in said)


def stamps(peer, name="gaussians") -> list[int]:
    return [stamp_of(m.header) for m in peer.messages(f"/storm/output/{name}", CLOUD)]


def expect(condition, what):
    if not condition:
        raise AssertionError(what)


def close(a, b, what):
    if a.dtype.names:
        expect(a.dtype == b.dtype and a.shape == b.shape, f"{what}: {a.dtype} {a.shape} against {b.dtype} {b.shape}")
        for name in a.dtype.names:
            if name == "rgb":
                # Packed bytes: a value at the edge of a rounding may come out one step apart.
                ab, bb = (np.frombuffer(x[name].tobytes(), np.uint8).astype(int) for x in (a, b))
                expect(np.abs(ab - bb).max(initial=0) <= 1, f"{what}.{name}")
            else:
                off = np.abs(a[name].astype(np.float64) - b[name].astype(np.float64)).max(initial=0)
                expect(off <= TOLERANCE, f"{what}.{name}: off by {off}")
    else:
        off = np.abs(a.astype(np.float64) - b.astype(np.float64)).max(initial=0)
        expect(a.shape == b.shape and off <= TOLERANCE, f"{what}: off by {off}")
