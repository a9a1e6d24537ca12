#!/usr/bin/env python3
"""The live node against real ROS 2 peers over DDS.

    source PREFIX/env.sh && python tests/ros/run.py PROGRAM [SCENARIO]...

PROGRAM is a `storm` with the feature `ros`. Scenarios run one after the other, each in a process group of its own; all of
them without names. The exit code is 1 when one fails.
"""
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
SCENARIOS = ["same_as_replay", "qos_mismatch", "pose_dropout", "camera_dropout", "clock_jump", "burst", "interrupted",
             "services_and_parameters", "bad_arguments", "sim_time", "tf_pose"]
# A scenario that takes longer hangs.
LIMIT_SEC = 150


def main() -> int:
    program = str(Path(sys.argv[1]).resolve())
    wanted = sys.argv[2:] or SCENARIOS
    work = Path(tempfile.mkdtemp(prefix="storm_ros_"))
    bag = work / "bag"
    subprocess.run([program, "--quiet", "synth", "--seed", "3", "--seconds", "4", "--out", bag], check=True, timeout=120,
                   stdout=subprocess.DEVNULL)
    failed = []
    for number, name in enumerate(wanted):
        # A domain of its own for every scenario, on this machine alone.
        domain = 1 + (os.getpid() * 13 + number) % 100
        env = dict(os.environ, ROS_DOMAIN_ID=str(domain), ROS_AUTOMATIC_DISCOVERY_RANGE="LOCALHOST",
                   ROS_LOG_DIR=str(work / "log"))
        start = time.monotonic()
        process = subprocess.Popen([sys.executable, HERE / "scenarios.py", name, program, bag, work], env=env,
                                   start_new_session=True)
        try:
            code = process.wait(timeout=LIMIT_SEC)
        except subprocess.TimeoutExpired:
            code = "no end"
        # Whatever it started ends with it; a node has a group of its own and is looked for by name.
        left = strays(program)
        for group in [process.pid, *left]:
            try:
                os.killpg(group, 9)
            except ProcessLookupError:
                pass
        outcome = "passed" if code == 0 and not left else f"FAILED (exit {code}, stray processes {left})"
        print(f"{name}: {outcome} in {time.monotonic() - start:.1f} s", flush=True)
        if outcome != "passed":
            failed.append(name)
    subprocess.run(["rm", "-rf", work])
    return 1 if failed else 0


def strays(program: str) -> list[int]:
    """Nodes of this program that still run."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        try:
            args = (entry / "cmdline").read_bytes().split(b"\0")
        except OSError:
            continue
        if args[0].decode(errors="replace") == program and b"node" in args:
            found.append(int(entry.name))
    return found


if __name__ == "__main__":
    sys.exit(main())
