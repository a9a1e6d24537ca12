"""What the live node has to stand; each function is one scenario, run by run.py in a process of its own."""
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rosgraph_msgs.msg import Clock
from std_srvs.srv import SetBool, Trigger

from peer import (BEST_EFFORT, LATCHED, RELIABLE, Peer, StormNode, diagnosis, points, read_bag, stamp_of, until)

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


def same_as_replay(program, bag, work):
    """Every output message of the live node is the replay's: types, frames, stamps, values.

    Without what overlapping windows say of each other: that depends on which windows were run, and a live node rightly passes
    over a set for a newer one.
    """
    out = work / "replay"
    subprocess.run([program, "--quiet", "replay", bag, "--out", out, "--set", "output.score_held_out=false", "--set",
                    "overlap.enabled=false"],
                   timeout=120, stdout=subprocess.DEVNULL, check=True)
    replayed = {}
    for m in read_bag(out / "outputs.mcap"):
        value = m.value()
        key = stamp_of((value.transforms[0] if hasattr(value, "transforms") else value).header)
        replayed[m.topic, key] = (m.type_name, value)
    steps = sorted(s for t, s in replayed if t == "/storm/output/gaussians")
    expect(len(steps) > 20, f"{len(steps)} steps replayed")
    drive = Drive(bag)
    with Peer() as peer:
        peer.offer(drive.messages)
        with StormNode(program, RELIABLE_INPUT | {"overlap.enabled": "false"}) as node:
            topics = {"/storm/output/gaussians": CLOUD, "/storm/output/flow": CLOUD, "/storm/output/map": CLOUD,
                      "/storm/output/map_update": CLOUD, "/storm/output/tracks": CLOUD,
                      "/storm/output/objects": "visualization_msgs/msg/MarkerArray",
                      "/storm/output/detections": "vision_msgs/msg/Detection3DArray",
                      "/storm/output/trajectory": "nav_msgs/msg/Path", "/tf": "tf2_msgs/msg/TFMessage"}
            for i in range(CAMERAS):
                for name, kind in [("rendered", IMAGE), ("depth", IMAGE), ("motion_mask", IMAGE), ("mask_color", IMAGE),
                                   ("camera_info", INFO)]:
                    topics[f"/storm/output/camera{i}/{name}"] = kind
            for topic, kind in topics.items():
                peer.listen(topic, kind, LATCHED if topic == "/storm/output/map" else RELIABLE)
            running(peer, node, drive, listen=())
            done, sets, start = 0, drive.stamps(), time.monotonic()
            for m in drive.messages:
                # No faster than it was recorded: images of different cameras that are a second apart are a clock jump.
                time.sleep(max(0.0, (m.time_ns - drive.messages[0].time_ns) * 1e-9 - (time.monotonic() - start)))
                peer.play(m)
                if m.topic == drive.images[-1]:
                    # Nor faster than the node: each set once the step before the last is there.
                    done += 1
                    if done == 1:
                        # Now there are publishers; whoever is to hear the first step has to be known to them.
                        node.says("running:")
                        until(lambda: all(peer.node.count_publishers(t) for t in topics), 20, "publishers of all outputs")
                        time.sleep(1.0)
                        start = time.monotonic() - (m.time_ns - drive.messages[0].time_ns) * 1e-9
                    due = [s for s in steps if s <= sets[max(done - 2, 0)]]
                    if due and done > 1:
                        until(lambda: peer.count("/storm/output/gaussians") >= len(due), 20, f"step {len(due)}")
            until(lambda: peer.count("/storm/output/gaussians") >= len(steps) - 1, 20, "the last steps")
            time.sleep(1.5)
            status = newest(peer)
            expect(node.interrupt() == 0, f"exit code:\n{node.log()}")
        compared = 0
        for topic, kind in topics.items():
            if (topic, steps[-2]) not in replayed:
                continue
            live = peer.messages(topic, kind)
            expect(len(live) >= len(steps) - 2, f"{topic}: {len(live)} messages for {len(steps)} steps")
            for value in live:
                inner = value.transforms[0] if topic == "/tf" else value
                type_name, old = replayed[topic, stamp_of(inner.header)]
                old_inner = old.transforms[0] if topic == "/tf" else old
                where = f"{topic} at {stamp_of(inner.header)}"
                expect(type_name == kind, f"{where}: {type_name}")
                expect(inner.header.frame_id == old_inner.header.frame_id, f"{where}: frame {inner.header.frame_id}")
                if topic == "/tf":
                    t, o = inner.transform, old_inner.transform
                    for part, keys in [("translation", "xyz"), ("rotation", "xyzw")]:
                        for k in keys:
                            off = abs(getattr(getattr(t, part), k) - getattr(getattr(o, part), k))
                            expect(off < 1e-9, f"{where}: {part}.{k} off by {off}")
                elif kind == CLOUD:
                    expect((value.height, value.width, value.is_dense) == (old.height, old.width, old.is_dense), where)
                    close(points(value), points(old), where)
                elif kind == IMAGE:
                    expect((value.height, value.width, value.encoding) == (old.height, old.width, old.encoding), where)
                    read = np.float32 if value.encoding == "32FC1" else np.uint8
                    a, b = (np.frombuffer(bytes(v.data), read).astype(np.float64) for v in (value, old))
                    expect(np.abs(a - b).max() <= (TOLERANCE if read == np.float32 else 1), where)
                elif kind == INFO:
                    expect(np.allclose(value.k, old.k) and (value.width, value.height) == (old.width, old.height), where)
                compared += 1
        print(f"  {compared} messages of {len(steps)} steps are the replay's")
        level, message, values = status["losses"]
        expect(level == OK and values["images dropped, overflow"] == "0", f"{status['losses']}")
        moving(peer)
        whole = peer.last("/storm/output/map", CLOUD)
        expect(whole and whole.header.frame_id == "storm_origin" and whole.width > 1000, "the map is not there")
        updates = peer.messages("/storm/output/map_update", CLOUD)
        expect(updates and {"tile_x", "tile_y", "tile_z"} <= set(points(updates[0]).dtype.names), "no changed tiles")
        path = peer.last("/storm/output/trajectory", "nav_msgs/msg/Path")
        expect(path and len(path.poses) > 20 and path.header.frame_id == "map", "the path")


def moving(peer):
    """Tracks, objects and detections: present, named, finite."""
    clouds = peer.messages("/storm/output/tracks", CLOUD)
    rows = max((points(c) for c in clouds), key=len)
    expect(clouds[0].header.frame_id == "storm_origin" and len(rows) > 0, "no trajectories")
    expect({"vx", "age", "track_id"} <= set(rows.dtype.names), f"{rows.dtype.names}")
    expect(len(set(rows["track_id"])) == len(rows) and rows["age"].max() > 0, "trajectories are not told apart")
    arrays = peer.messages("/storm/output/objects", "visualization_msgs/msg/MarkerArray")
    expect(len(arrays) > 20, f"{len(arrays)} object messages")
    detections = peer.messages("/storm/output/detections", "vision_msgs/msg/Detection3DArray")
    boxes = [m for a in arrays for m in a.markers if m.type == 1]
    found = [d for a in detections for d in a.detections]
    expect(len(boxes) == len(found), f"{len(boxes)} boxes and {len(found)} detections")
    for box, d in zip(boxes, found):
        expect(box.header.frame_id == "map" and abs(box.pose.position.x - d.bbox.center.position.x) < 1e-9, "boxes differ")
        expect(d.id == str(box.id) and min(d.bbox.size.x, d.bbox.size.y, d.bbox.size.z) > 0, f"{d.id} {box.id}")
        q = box.pose.orientation
        expect(abs(q.x**2 + q.y**2 + q.z**2 + q.w**2 - 1) < 1e-6, "not a rotation")
    print(f"  {len(rows)} trajectories at most in a message, {len(boxes)} boxes in all")


def qos_mismatch(program, bag, work):
    """A best-effort publisher where reliable is asked for: named at once, with the fix."""
    drive = Drive(bag)
    with Peer("talker") as peer:
        peer.offer(drive.messages, BEST_EFFORT)
        with StormNode(program, RELIABLE_INPUT) as node:
            peer.listen("/diagnostics", DIAGNOSTICS)
            node.says("QoS mismatch on /camera0/image", 15)
            log = node.log()
            expect("/talker" in log and "live.reliability" in log and "best_effort" in log, log)
            until(lambda: ever(peer, "inputs", ERROR, "QoS mismatch"), 10, "mismatch in the diagnostics")
            node.interrupt()


def pose_dropout(program, bag, work):
    """No pose for 3 s: said, no step without poses, and all is well when they come again."""
    drive = Drive(bag)
    with Peer() as peer:
        peer.offer(drive.messages)
        with StormNode(program, RELIABLE_INPUT | {"live.silence_sec": 0.5}) as node:
            running(peer, node, drive)
            second = 4_000_000_000
            play(peer, drive)
            until(lambda: peer.count("/storm/output/gaussians") > 1, 20, "steps")
            seen = {}

            def note(t):
                if t > 1.5 and "before" not in seen:
                    seen["before"] = peer.count("/storm/output/gaussians")
                if t > 2.9 and "during" not in seen:
                    seen["during"] = peer.count("/storm/output/gaussians")

            play(peer, drive, skip=lambda topic, t: topic == "/odometry" and t < 3.0, by_ns=second, each=note)
            node.says("/odometry has sent nothing", 5)
            expect(seen["during"] - seen["before"] == 0, f"steps without poses: {seen}")
            play(peer, drive, by_ns=2 * second)
            node.says("/odometry is back", 5)
            last = drive.stamps()[-1] + 2 * second
            until(lambda: last - stamps(peer)[-1] < 500_000_000, 20, "steps after the pose came back")
            expect(ever(peer, "inputs", ERROR, "/odometry"), "the diagnostics never said that the pose stopped")
            expect(int(newest(peer)["losses"][2]["images dropped, pose_gap"]) +
                   int(newest(peer)["losses"][2]["images dropped, no_pose"]) > 20, f"{newest(peer)['losses']}")
            node.interrupt()


def camera_dropout(program, bag, work):
    """A camera stops: the node says so, goes on with two, and takes the third again."""
    drive = Drive(bag)
    with Peer() as peer:
        peer.offer(drive.messages)
        with StormNode(program, RELIABLE_INPUT | {"live.silence_sec": 0.5}) as node:
            running(peer, node, drive, listen=("gaussians", "flow"))
            play(peer, drive)
            step = 4_000_000_000
            play(peer, drive, skip=lambda topic, t: topic.startswith("/camera2"), by_ns=step)
            node.says("/camera2/image has sent nothing", 5)
            node.says("going on with cameras [0, 1]", 5)
            until(lambda: any(m.height == 2 * 64 for m in peer.messages("/storm/output/flow", CLOUD)), 10,
                  "flow of two cameras")
            play(peer, drive, by_ns=2 * step)
            node.says("/camera2/image is back", 5)
            node.says("going on with cameras [0, 1, 2]", 5)
            until(lambda: peer.last("/storm/output/flow", CLOUD).height == 3 * 64, 20, "flow of three cameras again")
            expect(ever(peer, "inputs", ERROR, "/camera2/image"), "the diagnostics never named the camera")
            expect(node.interrupt() == 0, node.log())


def clock_jump(program, bag, work):
    """The bag loops: stamps jump back by 4 s. A new epoch, and steps with the old stamps again."""
    drive = Drive(bag)
    with Peer() as peer:
        peer.offer(drive.messages)
        with StormNode(program, RELIABLE_INPUT) as node:
            running(peer, node, drive)
            play(peer, drive)
            until(lambda: peer.count("/storm/output/gaussians") > 1, 20, "steps")
            time.sleep(1.0)
            play(peer, drive)
            # Steps of before may still come; then stamps go back, once.
            back = lambda: [i for i, (a, b) in enumerate(zip(stamps(peer), stamps(peer)[1:])) if b < a]
            until(lambda: back() and len(stamps(peer)) > back()[0] + 2, 20, "steps after the jump")
            expect(len(back()) == 1, f"{stamps(peer)}")
            until(lambda: int(newest(peer)["pipeline"][2]["clock jumps and resets"]) == 1, 5, "one clock jump")
            expect(node.interrupt() == 0, node.log())


def burst(program, bag, work):
    """120 images at once: nothing is worked off that newer images make worthless, all of it is counted, and the node goes on
    with what comes next."""
    drive = Drive(bag)
    with Peer() as peer:
        peer.offer(drive.messages)
        with StormNode(program, RELIABLE_INPUT | {"live.queue": 20}) as node:
            running(peer, node, drive)
            play(peer, drive)
            until(lambda: peer.count("/storm/output/gaussians") > 1, 20, "steps")
            before, turn = len(stamps(peer)), 4_000_000_000
            # As fast as DDS takes them: 120 images, and the poses.
            play(peer, drive, by_ns=turn, speed=1000.0)
            time.sleep(2.5)
            during = len(stamps(peer)) - before
            expect(during < 30, "the burst was worked off instead of skipped")
            play(peer, drive, by_ns=2 * turn)
            last = drive.stamps()[-1] + 2 * turn
            until(lambda: last - stamps(peer)[-1] <= 500_000_000, 30, "a step near the end")
            time.sleep(1.5)
            now = newest(peer)
            values = now["losses"][2]
            lost = sum(int(v) for k, v in values.items() if k.startswith("images dropped"))
            skipped = sum(int(v) for k, v in values.items() if k.startswith("sets skipped"))
            print(f"  {during} steps in the burst, {lost} images dropped, {skipped} sets skipped")
            held = int(values["images in"]) - lost - int(values["images used"])
            expect(0 <= held <= 3 * CAMERAS, f"images unaccounted for: {values}")
            expect(now["pipeline"][2]["clock jumps and resets"] == "0", "a burst is no clock jump")
            expect(node.interrupt() == 0, node.log())


def interrupted(program, bag, work):
    """SIGINT while steps run: the step ends, the map is saved, the process is gone with exit code 0."""
    drive, maps = Drive(bag), work / "maps"
    with Peer() as peer:
        peer.offer(drive.messages)
        with StormNode(program, RELIABLE_INPUT | {"live.map_dir": maps}) as node:
            running(peer, node, drive)
            play(peer, drive, seconds=3.0)
            until(lambda: peer.count("/storm/output/gaussians") > 0, 20, "steps")
            start = time.monotonic()
            expect(node.interrupt(10) == 0, node.log())
            print(f"  ended {time.monotonic() - start:.2f} s after the signal")
            node.says("map saved")
        checked = subprocess.run([program, "map", maps], capture_output=True, text=True, timeout=60)
        expect(checked.returncode == 0, checked.stderr)
        # A node that waits for topics ends as well.
        with StormNode(program, {"input.images": "[/nowhere]"}) as node:
            node.says("waiting", 15)
            expect("/nowhere" in node.log(), node.log())
            expect(node.interrupt(10) == 0, node.log())


def services_and_parameters(program, bag, work):
    """Services answer and do; parameters are listed, described, checked."""
    drive, maps = Drive(bag), work / "service_maps"
    with Peer() as peer:
        peer.offer(drive.messages)
        with StormNode(program, RELIABLE_INPUT | {"live.map_dir": maps}) as node:
            running(peer, node, drive)
            refused = peer.call(Trigger, "/storm/save_map", Trigger.Request())
            expect(not refused.success and "not running yet" in refused.message, refused)
            play(peer, drive)
            until(lambda: peer.count("/storm/output/gaussians") > 1, 20, "steps")
            # Who joins late gets the whole map, although nothing comes in any more.
            time.sleep(0.5)
            peer.listen("/storm/output/map", CLOUD, LATCHED)
            until(lambda: peer.count("/storm/output/map") > 0, 10, "map for a late listener")
            saved = peer.call(Trigger, "/storm/save_map", Trigger.Request())
            expect(saved.success and "Gaussians" in saved.message, saved)
            parameters(peer)
            set_one(peer, "map.load", ParameterValue(type=4, string_value=str(maps)), True)
            loaded = peer.call(Trigger, "/storm/load_map", Trigger.Request())
            expect(loaded.success and "Gaussians from" in loaded.message, loaded)
            paused = peer.call(SetBool, "/storm/pause", SetBool.Request(data=True))
            expect(paused.success, paused)
            time.sleep(0.5)
            before = peer.count("/storm/output/gaussians")
            play(peer, drive, by_ns=4_000_000_000)
            expect(peer.count("/storm/output/gaussians") == before, "steps while paused")
            expect(peer.call(SetBool, "/storm/pause", SetBool.Request(data=False)).success, "resume")
            play(peer, drive, by_ns=8_000_000_000)
            until(lambda: peer.count("/storm/output/gaussians") > before, 20, "steps after the pause")
            reset = peer.call(Trigger, "/storm/reset", Trigger.Request())
            expect(reset.success, reset)
            play(peer, drive, by_ns=12_000_000_000)
            last = drive.stamps()[-1] + 12_000_000_000
            until(lambda: last - stamps(peer)[-1] < 500_000_000, 20, "steps after the reset")
            expect(node.interrupt() == 0, node.log())


def set_one(peer, name, value, accepted):
    request = SetParameters.Request(parameters=[Parameter(name=name, value=value)])
    result = peer.call(SetParameters, "/storm/set_parameters", request).results[0]
    expect(result.successful == accepted, f"{name}: {result}")
    return result.reason


def parameters(peer):
    names = peer.call(ListParameters, "/storm/list_parameters", ListParameters.Request()).result.names
    expect(len(names) > 80 and "window.stride_sec" in names and "use_sim_time" in names, f"{len(names)} parameters")
    described = peer.call(DescribeParameters, "/storm/describe_parameters", DescribeParameters.Request(names=names))
    expect(all(len(d.description) > 10 and d.type > 0 for d in described.descriptors), "a parameter without its meaning")
    values = peer.call(GetParameters, "/storm/get_parameters", GetParameters.Request(names=["live.cameras", "window.hop_sec"]))
    expect(values.values[0].integer_value == CAMERAS and values.values[1].double_value == 0.0, f"{values}")
    double = lambda x: ParameterValue(type=3, double_value=x)
    set_one(peer, "window.hop_sec", double(0.05), True)
    expect("0 to 60" in set_one(peer, "window.hop_sec", double(-1.0), False), "no reason")
    expect("start" in set_one(peer, "window.stride_sec", double(0.4), False), "no reason")
    set_one(peer, "window.strid_sec", double(0.4), False)


def bad_arguments(program, bag, work):
    """Wrong parameters and arguments end the node at once, with exit code 1 and the name of what is wrong."""
    file = work / "bad.yaml"
    file.write_text("/**:\n  ros__parameters:\n    window:\n      strid_sec: 0.5\n")
    for args, word in [(["-p", "window.strid_sec:=0.4"], "strid_sec"), (["-p", "window.timesteps:=11"], "11"),
                       (["-p", "window.timesteps:=many"], "many"), (["--params-file", str(file)], "strid_sec"),
                       (["--params-file", "/no/such.yaml"], "no/such.yaml"), (["-p", "nonsense"], "nonsense"),
                       (["-p", "model.weights:=/no/such.pth"], "no/such.pth")]:
        done = subprocess.run([program, "node", "--ros-args", *args], capture_output=True, text=True, timeout=30)
        expect(done.returncode in (1, 2) and word in done.stderr, f"{args}: {done.returncode}\n{done.stderr}")
        expect("panicked" not in done.stderr, done.stderr)
    done = subprocess.run([program, "node", "live.cameras:=3"], capture_output=True, text=True, timeout=30)
    expect(done.returncode == 1 and "--ros-args" in done.stderr, done.stderr)
    # The shipped file is one for ROS.
    shipped = Path(__file__).resolve().parents[2] / "config" / "storm.yaml"
    with StormNode(program, {"live.cameras": 1}, more=("--params-file", str(shipped))) as node:
        node.says("looking for cameras")
        expect(node.interrupt() == 0, node.log())


def sim_time(program, bag, work):
    """Under /clock a stopped clock is no silence, and ages are of simulated time."""
    drive = Drive(bag)
    start = drive.messages[0].time_ns
    with Peer() as peer:
        peer.offer(drive.messages)
        clock = peer.node.create_publisher(Clock, "/clock", 10)

        def tick(t):
            now = start + int(t * 1e9)
            message = Clock()
            message.clock.sec, message.clock.nanosec = now // 10**9, now % 10**9
            clock.publish(message)

        with StormNode(program, RELIABLE_INPUT | {"use_sim_time": "true", "live.silence_sec": 0.5}) as node:
            running(peer, node, drive)
            play(peer, drive, each=tick)
            until(lambda: peer.count("/storm/output/gaussians") > 1, 20, "steps")
            # The bag is paused: time stands still.
            time.sleep(2.0)
            expect("has sent nothing" not in node.log(), node.log())
            age = float(newest(peer)["pipeline"][2]["age of the newest step (ms)"])
            expect(abs(age) < 5000, f"age {age} ms is not of simulated time")
            expect(node.interrupt() == 0, node.log())


def tf_pose(program, bag, work):
    """Poses from /tf, pictures best effort: steps with the frames of a vehicle that only has transforms."""
    from geometry_msgs.msg import TransformStamped
    from nav_msgs.msg import Odometry
    from rclpy.serialization import deserialize_message
    from tf2_msgs.msg import TFMessage
    drive = Drive(bag)
    with Peer() as peer:
        peer.offer([m for m in drive.messages if m.topic != "/odometry"], BEST_EFFORT)
        tf = peer.node.create_publisher(TFMessage, "/tf", 100)
        odometry = [m for m in drive.messages if m.topic == "/odometry"]
        drive.messages = [m for m in drive.messages if m.topic != "/odometry"]
        transforms = []
        for m in odometry:
            o = deserialize_message(m.data, Odometry)
            t = TransformStamped(header=o.header, child_frame_id=o.child_frame_id)
            p = o.pose.pose
            t.transform.translation.x, t.transform.translation.y, t.transform.translation.z = \
                p.position.x, p.position.y, p.position.z
            t.transform.rotation = p.orientation
            transforms.append((m.time_ns, t))
        first = drive.messages[0].time_ns
        with StormNode(program, {"live.cameras": CAMERAS, "input.pose": "/tf"}) as node:
            running(peer, node, drive)

            def send(t):
                while transforms and (transforms[0][0] - first) * 1e-9 <= t:
                    tf.publish(TFMessage(transforms=[transforms.pop(0)[1]]))

            play(peer, drive, each=send)
            until(lambda: peer.count("/storm/output/gaussians") > 3, 20, f"steps:\n{node.log()}\n{newest(peer)}")
            expect(node.interrupt() == 0, node.log())


if __name__ == "__main__":
    scenario, program, bag, work = sys.argv[1], sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4])
    globals()[scenario](program, bag, work)
    # Some middleware threads outlive rclpy's shutdown; nothing of ours is left to clean up.
    sys.stdout.flush()
    os._exit(0)
