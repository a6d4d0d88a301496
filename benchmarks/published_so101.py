"""Published servo parameters of the SO-101 as rivals of an identification.

    gaponet experiment real --sets so101 so101_another_day --method benchmarks/published_so101.py:community \
        --method benchmarks/published_so101.py:hand_tuned

Each is published for all joints: kp N·m/rad, damping N·m·s/rad, armature kg·m², dry friction N·m. Delay and offset: 0.
"""

from gaponet.experiments.real.methods import FittedSim
from gaponet.experiments.real.questions import Question

SETS = {"community MJCF": (17.8, 0.60, 0.028, 0.052), "hand-tuned before AnchorBench": (33.0, 1.6, 0.02, 0.0)}


def community(question: Question) -> FittedSim:
    """Return the values of the community's MJCF."""
    return _published(question, "community MJCF")


def hand_tuned(question: Question) -> FittedSim:
    """Return the values that were tuned by hand before AnchorBench."""
    return _published(question, "hand-tuned before AnchorBench")


def _published(question: Question, name: str) -> FittedSim:
    kp, damping, armature, friction = SETS[name]
    servo = {"kp": kp, "damping": damping, "armature": armature, "frictionloss": friction}
    return FittedSim(question.robot.with_servos(dict.fromkeys(question.robot.operated, servo)), note=name)
