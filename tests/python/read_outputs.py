#!/usr/bin/env python3
"""Reads bags with two independent libraries and says what is in them.

    pip install mcap mcap-ros2-support rosbags numpy
    read_outputs.py BAG [BAG ...] [--expect FILE.json]

BAG is an MCAP file or a bag folder. Every message is decoded with mcap-ros2-support (from the schemas inside the file)
and with rosbags (from ROS 2 Jazzy's own definitions); both must agree on every field. Point clouds must hold as many
bytes as their sizes say and nothing that is not finite. Topics and their counts are printed. The exit code is 1 when
anything fails.

--expect names a JSON object `topic -> {field path: value}` checked on the topic's first message. A path is written with
dots; `#` is a length, a number an index, and `points` leads into a point cloud's rows.
"""

import argparse
import json
import sys
from collections import Counter
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

POINT_TYPES = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 8: "<f8"}
TYPESTORE = get_typestore(Stores.ROS2_JAZZY)


def mcap_files(bag: Path) -> list[Path]:
    return sorted(bag.glob("*.mcap")) if bag.is_dir() else [bag]


def read_with_mcap(bag: Path):
    """(topic, log time, message, channel) of every message."""
    for path in mcap_files(bag):
        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            if reader.get_header().profile != "ros2":
                raise ValueError(f"{path}: profile {reader.get_header().profile!r}, not ros2")
            if reader.get_summary() is None:
                raise ValueError(f"{path}: no summary section")
            for _, channel, message, decoded in reader.iter_decoded_messages(log_time_order=False):
                yield channel.topic, message.log_time, decoded, channel


def read_with_rosbags(bag: Path):
    with AnyReader([bag], default_typestore=TYPESTORE) as reader:
        for connection, stamp, raw in reader.messages():
            yield connection.topic, stamp, TYPESTORE.deserialize_cdr(raw, connection.msgtype), connection


def flatten(value, prefix=""):
    """Leaves of a message as {path: value}; arrays stay whole."""
    if isinstance(value, (bytes, bytearray, memoryview)):
        return {prefix: np.frombuffer(value, np.uint8)}
    if isinstance(value, np.ndarray):
        return {prefix: value}
    if isinstance(value, (list, tuple)):
        if all(isinstance(v, (int, float, np.number)) for v in value):
            return {prefix: np.asarray(value)}
        leaves = {f"{prefix}.#": len(value)}
        for i, v in enumerate(value):
            leaves |= flatten(v, f"{prefix}.{i}")
        return leaves
    if isinstance(value, (bool, int, float, str, np.number)):
        return {prefix: value}
    names = getattr(value, "__slots__", None) or value.__dict__
    leaves = {}
    for name in names:
        field = getattr(value, name)
        # Constants and bookkeeping are no fields.
        if not name.startswith("_") and name.islower():
            leaves |= flatten(field, f"{prefix}.{name}" if prefix else name)
    return leaves


def same(a, b) -> bool:
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        a, b = np.asarray(a), np.asarray(b)
        return a.shape == b.shape and np.array_equal(a, b)
    return a == b


def points(message) -> np.ndarray:
    """Rows of a PointCloud2."""
    dtype = np.dtype({
        "names": [f.name for f in message.fields],
        "formats": [POINT_TYPES[f.datatype] for f in message.fields],
        "offsets": [f.offset for f in message.fields],
        "itemsize": message.point_step,
    })
    return np.frombuffer(bytes(message.data), dtype)


def check_cloud(message) -> list[str]:
    problems = []
    if message.row_step != message.point_step * message.width:
        problems.append(f"row_step {message.row_step} is not point_step * width")
    rows = points(message)
    if len(rows) != message.width * message.height:
        problems.append(f"{len(rows)} rows where {message.width} x {message.height} belong")
    for name in rows.dtype.names:
        if rows[name].dtype.kind == "f" and not np.isfinite(rows[name]).all():
            problems.append(f"column {name} holds a number that is not finite")
    return problems


def look_up(message, path: str):
    value = message
    for word in path.split("."):
        if word == "#":
            value = len(value)
        elif word == "points":
            value = points(value)
        elif word.isdigit():
            value = value[int(word)]
        else:
            value = value[word] if isinstance(value, np.void) else getattr(value, word)
    return value


def check_bag(bag: Path, expected: dict) -> list[str]:
    problems, counts, types, first = [], Counter(), {}, {}
    ours = sorted(read_with_mcap(bag), key=lambda m: (m[1], m[0]))
    theirs = sorted(read_with_rosbags(bag), key=lambda m: (m[1], m[0]))
    if [m[:2] for m in ours] != [m[:2] for m in theirs]:
        problems.append(f"mcap finds {len(ours)} messages, rosbags {len(theirs)}, or their order differs")
    for (topic, stamp, a, channel), (_, _, b, connection) in zip(ours, theirs):
        counts[topic] += 1
        types[topic] = connection.msgtype
        first.setdefault(topic, a)
        left, right = flatten(a), flatten(b)
        if left.keys() != right.keys():
            problems.append(f"{topic} at {stamp}: fields differ: {sorted(left.keys() ^ right.keys())}")
        problems += [f"{topic} at {stamp}: {k}: {left[k]} != {right[k]}"
                     for k in left.keys() & right.keys() if not same(left[k], right[k])]
        if connection.msgtype == "sensor_msgs/msg/PointCloud2":
            problems += [f"{topic} at {stamp}: {p}" for p in check_cloud(a)]
        if connection.msgtype == "sensor_msgs/msg/Image" and len(a.data) != a.step * a.height:
            problems.append(f"{topic} at {stamp}: {len(a.data)} bytes where step * height is {a.step * a.height}")
        stated = channel.metadata.get("topic_type_hash")
        if stated is not None and stated != TYPESTORE.hash_rihs01(connection.msgtype):
            problems.append(f"{topic}: type hash {stated} is not that of {connection.msgtype}")
        if "offered_qos_profiles" not in channel.metadata:
            problems.append(f"{topic}: no offered_qos_profiles")
    for topic, fields in expected.items():
        for path, value in fields.items():
            try:
                found = look_up(first[topic], path)
            except (KeyError, IndexError, AttributeError) as error:
                problems.append(f"{topic}: {path} is not there ({error!r})")
                continue
            equal = found == value or (isinstance(value, float) and np.float32(value) == found)
            if not equal:
                problems.append(f"{topic}: {path} is {found!r}, expected {value!r}")
    print(f"{bag}: {sum(counts.values())} messages")
    for topic in sorted(counts):
        print(f"  {counts[topic]:6}  {topic}  {types[topic]}")
    return problems


def main() -> int:
    parser = argparse.ArgumentParser(description="Reads bags with two libraries and compares what they find.")
    parser.add_argument("bags", nargs="+", type=Path)
    parser.add_argument("--expect", type=Path, help="JSON with the values the first message of each topic must hold")
    args = parser.parse_args()
    expected = json.loads(args.expect.read_text()) if args.expect else {}
    failed = False
    for bag in args.bags:
        try:
            problems = check_bag(bag, expected)
        except Exception as error:  # whatever a library raises means that the bag cannot be read
            problems = [f"cannot be read: {error!r}"]
        for problem in problems[:20]:
            print(f"{bag}: {problem}", file=sys.stderr)
        if len(problems) > 20:
            print(f"{bag}: and {len(problems) - 20} more", file=sys.stderr)
        failed |= bool(problems)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
