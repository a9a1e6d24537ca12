"""What the live node publishes is what a replay of the same bag gives."""
import subprocess
import time

import numpy as np

from drive import CAMERAS, CLOUD, Drive, IMAGE, INFO, OK, RELIABLE_INPUT, TOLERANCE, close, expect, newest, running
from peer import LATCHED, RELIABLE, Peer, StormNode, points, read_bag, stamp_of, until

OBJECTS = "/storm/output/objects"
# Of about 25.
FEWEST_STEPS = 20


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
                      OBJECTS: "visualization_msgs/msg/MarkerArray",
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
                        peer.hears(topics)
                        until(lambda: heard(peer) >= set(topics), 20, "the node to know of all who listen")
                        start = time.monotonic() - (m.time_ns - drive.messages[0].time_ns) * 1e-9
                    due = [s for s in steps if s <= sets[max(done - 2, 0)]]
                    if due and done > 1:
                        until(lambda: peer.count("/storm/output/gaussians") >= len(due), 20, f"step {len(due)}")
            until(lambda: peer.count("/storm/output/gaussians") >= len(steps) - 1, 20, "the last steps")
            # This process takes them one by one; on a busy machine it is behind.
            every = [t for t in topics if (t, steps[-2]) in replayed]
            until(lambda: all(peer.count(t) >= len(steps) - 2 for t in every), 20,
                  lambda: f"{len(steps)} steps on {dict((t, peer.count(t)) for t in every)}")
            until(lambda: peer.count(OBJECTS) > FEWEST_STEPS, 20, lambda: f"{peer.count(OBJECTS)} object messages")
            time.sleep(1.5)
            status = newest(peer)
            expect(node.interrupt() == 0, f"exit code:\n{node.log()}")
        compared = 0
        for topic, kind in topics.items():
            if topic not in every:
                continue
            live = peer.messages(topic, kind)
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


def heard(peer) -> set[str]:
    """The output topics that the node knows a listener of: on the others it does not send."""
    values = newest(peer).get("outputs", (OK, "", {}))[2]
    return {key.removesuffix(" subscriptions") for key, count in values.items() if count != "0"}


def moving(peer):
    """Tracks, objects and detections: present, named, finite."""
    clouds = peer.messages("/storm/output/tracks", CLOUD)
    rows = max((points(c) for c in clouds), key=len)
    expect(clouds[0].header.frame_id == "storm_origin" and len(rows) > 0, "no trajectories")
    expect({"vx", "age", "track_id"} <= set(rows.dtype.names), f"{rows.dtype.names}")
    expect(len(set(rows["track_id"])) == len(rows) and rows["age"].max() > 0, "trajectories are not told apart")
    arrays = peer.messages(OBJECTS, "visualization_msgs/msg/MarkerArray")
    expect(len(arrays) > FEWEST_STEPS, f"{len(arrays)} object messages")
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
