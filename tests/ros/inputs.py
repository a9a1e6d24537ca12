"""Inputs that stop, jump, come all at once, or come under another clock."""
import time

from rosgraph_msgs.msg import Clock

from drive import CAMERAS, CLOUD, DIAGNOSTICS, Drive, ERROR, RELIABLE_INPUT, ever, expect, newest, play, running, stamps
from peer import BEST_EFFORT, Peer, StormNode, until


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
