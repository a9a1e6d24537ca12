"""What the ROS tests share: the node as a process, bags played over DDS, outputs collected.

Needs a sourced ROS 2 (`.ci/ros-prefix`) and the Python package mcap. Every node runs in a process group of its own and is
ended with it; everything that waits has a limit.
"""
import importlib
import os
import signal
import subprocess
import tempfile
import threading
import time
from collections import defaultdict
from pathlib import Path

import numpy as np
import rclpy
from mcap.reader import make_reader
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.serialization import deserialize_message

RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
BEST_EFFORT = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
LATCHED = QoSProfile(depth=10, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
POINT_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}


def get_message(type_name: str):
    """The class of `sensor_msgs/msg/Image`."""
    package, kind, name = type_name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def stamp_of(header) -> int:
    return header.stamp.sec * 10**9 + header.stamp.nanosec


def points(cloud) -> np.ndarray:
    """Rows of a PointCloud2."""
    dtype = np.dtype({
        "names": [f.name for f in cloud.fields],
        "formats": [POINT_TYPES[f.datatype] for f in cloud.fields],
        "offsets": [f.offset for f in cloud.fields],
        "itemsize": cloud.point_step,
    })
    return np.frombuffer(bytes(cloud.data), dtype)


def until(done, seconds: float, what):
    """Waits for `done()`; raises when it takes too long, saying `what` was waited for (or `what()` as it is then)."""
    end = time.monotonic() + seconds
    while not (value := done()):
        if time.monotonic() > end:
            raise AssertionError(f"after {seconds} s still no {what() if callable(what) else what}")
        time.sleep(0.01)
    return value


class Message:
    """One message of a bag."""

    def __init__(self, topic, type_name, data, time_ns):
        self.topic, self.type_name, self.data, self.time_ns = topic, type_name, data, time_ns

    def value(self):
        return deserialize_message(self.data, get_message(self.type_name))


def read_bag(path: Path) -> list[Message]:
    """All messages, in order of log time."""
    out = []
    for file in sorted(path.glob("*.mcap")) if path.is_dir() else [path]:
        with file.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                out.append(Message(channel.topic, schema.name, message.data, message.log_time))
    return out


class StormNode:
    """`storm node` as a process."""

    def __init__(self, program: str, parameters: dict | None = None, more: tuple = ()):
        args = [program, "node", "--ros-args"]
        for key, value in (parameters or {}).items():
            args += ["-p", f"{key}:={value}"]
        self.file = tempfile.NamedTemporaryFile(prefix="storm_node_", suffix=".log")
        env = dict(os.environ, RUST_LOG="info")
        self.process = subprocess.Popen(
            args + list(more), stdout=self.file, stderr=subprocess.STDOUT, env=env, start_new_session=True)

    def log(self) -> str:
        return Path(self.file.name).read_text(errors="replace")

    def says(self, text: str, seconds: float = 30.0):
        until(lambda: text in self.log() or self.process.poll() is not None, seconds, f"'{text}' in the log:\n{self.log()}")
        if text not in self.log():
            raise AssertionError(f"the node ended with {self.process.returncode} before '{text}':\n{self.log()}")

    def ended(self, seconds: float) -> int:
        return self.process.wait(timeout=seconds)

    def interrupt(self, seconds: float = 20.0) -> int:
        os.killpg(self.process.pid, signal.SIGINT)
        return self.ended(seconds)

    def cpu_sec(self) -> float:
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        if kind:
            print(f"--- the node said:\n{self.log()[-4000:]}---", flush=True)
        if self.process.poll() is None:
            os.killpg(self.process.pid, signal.SIGKILL)
            self.process.wait()
        self.file.close()


class Peer:
    """A ROS node in this process that plays bags and keeps what it hears."""

    def __init__(self, name: str = "peer"):
        rclpy.init()
        self.node = Node(name)
        self.publishers = {}
        self.subscriptions = {}
        self.heard = defaultdict(list)
        self.arrived = defaultdict(list)
        self.lock = threading.Lock()
        self.executor = SingleThreadedExecutor()
        self.executor.add_node(self.node)
        self.ending = False
        self.thread = threading.Thread(target=self.spin, daemon=True)
        self.thread.start()

    def spin(self):
        try:
            self.executor.spin()
        except Exception:
            # rclpy's executor may stumble over its own shutdown; anything before that is an error.
            if not self.ending:
                raise

    def __enter__(self):
        return self

    def __exit__(self, kind, *_):
        self.ending = True
        if kind and self.count("/diagnostics"):
            for part in diagnosis(self.last("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray")).items():
                print("--- diagnostics:", *part, flush=True)
        self.executor.shutdown(timeout_sec=5)
        self.thread.join(timeout=5)
        self.node.destroy_node()
        rclpy.shutdown()

    def publisher(self, topic: str, type_name: str, qos=RELIABLE):
        if topic not in self.publishers:
            self.publishers[topic] = self.node.create_publisher(get_message(type_name), topic, qos)
        return self.publishers[topic]

    def offer(self, messages, qos=RELIABLE):
        """A publisher for every topic of `messages`."""
        for m in messages:
            self.publisher(m.topic, m.type_name, LATCHED if m.topic == "/tf_static" else qos)

    def play(self, message: Message, data: bytes | None = None):
        self.publishers[message.topic].publish(data if data is not None else message.data)

    def matched(self, topics, seconds: float = 20.0):
        until(lambda: all(self.publishers[t].get_subscription_count() > 0 for t in topics), seconds,
              f"subscription on all of {list(topics)}")

    def hears(self, topics, seconds: float = 20.0):
        """Waits until the subscriptions have found their publishers; what those sent before is lost to them."""
        until(lambda: all(self.subscriptions[t].get_publisher_count() > 0 for t in topics), seconds,
              f"publishers of all of {list(topics)}")

    def listen(self, topic: str, type_name: str, qos=RELIABLE, keep: bool = True):
        def take(data):
            with self.lock:
                self.arrived[topic].append(time.time_ns())
                self.heard[topic].append(data if keep else data[:64])
        self.subscriptions[topic] = self.node.create_subscription(get_message(type_name), topic, take, qos, raw=True)
        return self.subscriptions[topic]

    def count(self, topic: str) -> int:
        with self.lock:
            return len(self.heard[topic])

    def messages(self, topic: str, type_name: str) -> list:
        with self.lock:
            return [deserialize_message(d, get_message(type_name)) for d in self.heard[topic]]

    def last(self, topic: str, type_name: str):
        with self.lock:
            data = self.heard[topic][-1] if self.heard[topic] else None
        return data and deserialize_message(data, get_message(type_name))

    def forget(self):
        with self.lock:
            self.heard.clear()
            self.arrived.clear()

    def call(self, kind, name: str, request, seconds: float = 20.0):
        client = self.node.create_client(kind, name)
        assert client.wait_for_service(timeout_sec=seconds), f"no service {name}"
        future = client.call_async(request)
        until(future.done, seconds, f"answer of {name}")
        self.node.destroy_client(client)
        return future.result()


def diagnosis(array) -> dict:
    """Name of the part -> (level, message, {key: value})."""
    level = lambda s: s.level[0] if isinstance(s.level, bytes) else s.level
    return {s.name.split(": ", 1)[1]: (level(s), s.message, {v.key: v.value for v in s.values}) for s in array.status}
