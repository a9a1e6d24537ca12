#!/usr/bin/env python3
"""How quick the live node is: 3 cameras of 640x480 JPEG at 10 Hz, publisher and subscriber in processes of their own.

    source PREFIX/env.sh && pip install pillow && python tests/ros/latency.py PROGRAM [--seconds 60] [--json FILE]

Runs the node twice, with every topic listened to and with `flow` alone. Latency is from an image's stamp (taken when it is
published) to the arrival of what was made from it; conversion and publishing is what the node itself says; processor time is
the node's, all threads. A machine that does other work at the same time makes all of it worse.
"""
import argparse
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from peer import BEST_EFFORT, LATCHED, RELIABLE, Peer, StormNode, diagnosis, read_bag, stamp_of, until

CLOUD, IMAGE, INFO = "sensor_msgs/msg/PointCloud2", "sensor_msgs/msg/Image", "sensor_msgs/msg/CameraInfo"
DIAGNOSTICS, NUMBER = "diagnostic_msgs/msg/DiagnosticArray", "std_msgs/msg/Float64"
# Time the node gets to fill its first window and to warm up, seconds.
WARM_UP = 6.0


def publish(bag: Path, rate: float):
    """Plays the bag forward and backward for ever with present stamps, pictures as JPEG."""
    from PIL import Image as Picture
    from sensor_msgs.msg import CompressedImage

    from rclpy.serialization import serialize_message
    messages = [m for m in read_bag(bag) if not m.topic.startswith("/ground_truth")]
    first = messages[0].time_ns
    by_topic = {}
    for m in messages:
        by_topic.setdefault(m.topic, []).append(m)
    odometry = [((m.time_ns - first) * 1e-9, m.data) for m in by_topic["/odometry"]]
    sets = {}
    for topic in [t for t in by_topic if t.endswith("/image")]:
        for m in by_topic[topic]:
            raw = m.value()
            out = io.BytesIO()
            Picture.frombytes("RGB", (raw.width, raw.height), bytes(raw.data)).save(out, "JPEG", quality=90)
            jpeg = CompressedImage(header=raw.header, format="jpeg", data=out.getvalue())
            at = round((stamp_of(raw.header) - first) * 1e-9, 3)
            sets.setdefault(at, []).append((topic + "/compressed", serialize_message(jpeg)))
    times = sorted(sets)
    with Peer("cameras") as peer:
        for topic, data in sets[times[0]]:
            peer.publisher(topic, "sensor_msgs/msg/CompressedImage", BEST_EFFORT)
        for topic in by_topic:
            if topic.endswith("camera_info"):
                peer.publisher(topic, INFO)
        peer.publisher("/odometry", "nav_msgs/msg/Odometry")
        peer.publisher("/tf_static", "tf2_msgs/msg/TFMessage", LATCHED)
        for m in by_topic["/tf_static"]:
            peer.play(m)
        stamp = lambda data, ns: (data[:4] + (ns // 10**9).to_bytes(4, "little") + (ns % 10**9).to_bytes(4, "little")
                                  + data[12:])
        pose_times = np.array([t for t, _ in odometry])
        there_and_back = times + times[-2:0:-1]
        step, k, poses_per_set = 1.0 / rate, 0, 5
        begin = time.time()
        while True:
            turn = divmod(k, poses_per_set)
            due = begin + k * step / poses_per_set
            time.sleep(max(0.0, due - time.time()))
            # The moment is the message's stamp: what a camera does.
            now = time.time_ns()
            a = there_and_back[turn[0] % len(there_and_back)]
            b = there_and_back[(turn[0] + 1) % len(there_and_back)]
            at = a + (b - a) * turn[1] / poses_per_set
            peer.publishers["/odometry"].publish(stamp(odometry[int(np.abs(pose_times - at).argmin())][1], now))
            if turn[1] == 0:
                for topic, data in sets[a]:
                    peer.publishers[topic].publish(stamp(data, now))
                for topic in by_topic:
                    if topic.endswith("camera_info"):
                        peer.publishers[topic].publish(stamp(by_topic[topic][0].data, now))
            k += 1


def measure(program: str, bag: Path, topics: dict, seconds: float, rate: float) -> dict:
    player = subprocess.Popen([sys.executable, __file__, "--publish", bag, "--rate", str(rate)], start_new_session=True)
    try:
        with Peer("listener") as peer:
            for topic, kind in topics.items():
                peer.listen(topic, kind, LATCHED if topic.endswith("/map") else RELIABLE, keep=False)
            peer.listen("/diagnostics", DIAGNOSTICS)
            for stage in ("publish", "network", "step", "latency"):
                peer.listen(f"/storm/debug/{stage}_ms", NUMBER, BEST_EFFORT)
            with StormNode(program, {"live.cameras": 3, "live.transport": "compressed"}) as node:
                until(lambda: peer.count("/storm/output/flow") > 3, 90, f"output:\n{node.log()}")
                time.sleep(WARM_UP)
                losses = lambda: diagnosis(peer.last("/diagnostics", DIAGNOSTICS))
                peer.forget()
                until(lambda: peer.count("/diagnostics") > 0, 5, "diagnostics")
                before, cpu, start = losses()["losses"][2], node.cpu_sec(), time.monotonic()
                time.sleep(seconds)
                wall, cpu = time.monotonic() - start, node.cpu_sec() - cpu
                time.sleep(1.2)
                now = losses()
                after, memory = now["losses"][2], now["pipeline"][2]["peak memory (MB)"]
                result = {"processor_share": cpu / wall, "peak_memory_mb": float(memory)}
                gone = lambda prefix: sum(int(after[k]) - int(before[k]) for k in after if k.startswith(prefix))
                result["images_in"] = int(after["images in"]) - int(before["images in"])
                result["images_dropped"] = gone("images dropped")
                result["sets_superseded"] = gone("sets skipped, superseded")
                with peer.lock:
                    flow = list(zip(peer.arrived["/storm/output/flow"], peer.heard["/storm/output/flow"]))
                late = [(at - int.from_bytes(d[4:8], "little") * 10**9 - int.from_bytes(d[8:12], "little")) * 1e-6
                        for at, d in flow]
                result["steps"] = len(late)
                # To the arrival in Python, which takes its own time; `latency_ms` is the node's own word.
                result["arrival_ms"] = quantiles(late)
                result["processor_ms_per_step"] = round(1e3 * cpu / max(len(late), 1), 1)
                for stage in ("publish", "network", "step", "latency"):
                    values = [m.data for m in peer.messages(f"/storm/debug/{stage}_ms", NUMBER)]
                    result[f"{stage}_ms"] = quantiles(values)
                result["listened"] = {t: peer.count(t) for t in topics}
                node.interrupt()
                return result
    finally:
        os.killpg(player.pid, 9)
        player.wait()


def quantiles(values) -> dict:
    return {f"p{q}": round(float(np.percentile(values, q)), 1) for q in (50, 99)} if values else {}


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("program", nargs="?", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--rate", type=float, default=10.0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--publish", type=Path, help="for its own use: be the publisher of this bag")
    args = parser.parse_args()
    if args.publish:
        return publish(args.publish, args.rate)
    os.environ.setdefault("ROS_DOMAIN_ID", str(101 - os.getpid() % 50))
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    program = str(args.program.resolve())
    every = {"/storm/output/gaussians": CLOUD, "/storm/output/flow": CLOUD, "/storm/output/map": CLOUD,
             "/storm/output/map_update": CLOUD, "/storm/output/tracks": CLOUD,
             "/storm/output/objects": "visualization_msgs/msg/MarkerArray",
             "/storm/output/trajectory": "nav_msgs/msg/Path", "/tf": "tf2_msgs/msg/TFMessage"}
    for i in range(3):
        every |= {f"/storm/output/camera{i}/{n}": IMAGE for n in ("rendered", "depth", "motion_mask", "mask_color")}
        every[f"/storm/output/camera{i}/camera_info"] = INFO
    with tempfile.TemporaryDirectory(prefix="storm_latency_") as work:
        bag = Path(work) / "bag"
        subprocess.run([program, "--quiet", "synth", "--seed", "3", "--seconds", "4", "--width", "640", "--height", "480",
                        "--out", bag], check=True, timeout=300, stdout=subprocess.DEVNULL)
        results = {"load_average": os.getloadavg()[0], "cores": os.cpu_count(), "seconds": args.seconds}
        for name, topics in [("all topics", every), ("flow alone", {"/storm/output/flow": CLOUD})]:
            results[name] = measure(program, bag, topics, args.seconds, args.rate)
            print(name, json.dumps(results[name], indent=1), flush=True)
    # Per step: on a machine that cannot keep up both take all there is, and differ in steps.
    spared = 1 - results["flow alone"]["processor_ms_per_step"] / results["all topics"]["processor_ms_per_step"]
    results["processor_time_spared_by_flow_alone"] = round(spared, 3)
    print(f"flow alone takes {100 * spared:.0f} % less processor time a step than all topics; load average {results['load_average']:.1f}")
    if args.json:
        args.json.write_text(json.dumps(results, indent=1) + "\n")
    # Some middleware threads outlive rclpy's shutdown.
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
