"""Correct a simulator that no training has seen: an SO-101 with stiffer servos and more friction.

    python examples/other_simulator.py DATASET        recordings of an SO-101, in gaponet's form

It prints the error of this simulator on motions that no training has seen: uncorrected, with the
network that is told the simulator's answers to fixed probes, and with the exact transfer.
"""

import sys

import numpy as np

import gaponet as gp

robot = gp.load_robot("so101")
friction = np.full(len(robot.joint_names), 0.156)  # N·m; the file has 0.052
mine = robot.with_servo(kp=2.2 * robot.servo.kp, frictionloss=friction)
methods = gp.evaluate("so101-simulators", sys.argv[1], robot=mine).methods
for name in ("uncorrected", "told", "transfer"):
    print(f"{name:12} {1e3 * methods[name]['mpjae']:.2f} mrad")
