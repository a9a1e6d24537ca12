"""Signals, services, parameters, arguments."""
import subprocess
import time
from pathlib import Path

from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from std_srvs.srv import SetBool, Trigger

from drive import CAMERAS, CLOUD, Drive, RELIABLE_INPUT, expect, play, running, stamps
from peer import LATCHED, Peer, StormNode, until


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
            paused_ns = drive.stamps()[0] + 4_000_000_000
            play(peer, drive, by_ns=4_000_000_000)
            expect(all(s < paused_ns for s in stamps(peer)), f"steps while paused: {stamps(peer)}")
            expect(peer.call(SetBool, "/storm/pause", SetBool.Request(data=False)).success, "resume")
            play(peer, drive, by_ns=8_000_000_000)
            until(lambda: any(s >= paused_ns for s in stamps(peer)), 20, "steps after the pause")
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
