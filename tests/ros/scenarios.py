"""What the live node has to stand: one scenario, run by run.py in a process of its own."""
import os
import sys
from pathlib import Path

import control
import inputs
import outputs

if __name__ == "__main__":
    scenario, program, bag, work = sys.argv[1], sys.argv[2], Path(sys.argv[3]), Path(sys.argv[4])
    next(getattr(room, scenario) for room in (outputs, inputs, control) if hasattr(room, scenario))(program, bag, work)
    # Some middleware threads outlive rclpy's shutdown; nothing of ours is left to clean up.
    sys.stdout.flush()
    os._exit(0)
