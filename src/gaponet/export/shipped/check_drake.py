"""Play the motions of check.npz in Drake, whose joints have no friction and actuators no delay: python check.py"""

import logging
from pathlib import Path

import numpy as np
import robot_cfg
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import MultibodyPlant
from pydrake.systems.analysis import Simulator

from gaponet.export.shipped.mujoco_servos import Check, delay_weights

logging.getLogger("drake").setLevel(
    logging.ERROR
)  # about parts of the MJCF that Drake ignores; robot_cfg.py has them
HERE = Path(__file__).parent
check = Check(HERE)
names, decimation = check.names, check.facts["decimation"]
plant = MultibodyPlant(check.step)
Parser(plant).AddModels(str(HERE / check.facts["file"]))
robot_cfg.add_servos(plant)
plant.Finalize()
joints = [plant.GetJointByName(name) for name in names]
at, dof = [j.position_start() for j in joints], [j.velocity_start() for j in joints]
simulator = Simulator(plant)
context = simulator.get_mutable_context()
desired = plant.get_desired_state_input_port(joints[0].model_instance())
forces = plant.get_applied_generalized_force_input_port()
weights = delay_weights([robot_cfg.DELAYS[name] for name in names], check.step)
offset = np.array([robot_cfg.OFFSETS[name] for name in names])
paths = []
for motion in check.motions:
    q, v = np.zeros(plant.num_positions()), np.zeros(plant.num_velocities())
    q[at], v[dof] = motion["qpos"][0], motion["qvel"][0]
    context.SetTime(0.0)
    plant.SetPositions(context, q)
    plant.SetVelocities(context, v)
    simulator.Initialize()
    past, path = np.tile(motion["ctrl"][0], (len(weights), 1)), []
    for k in range(len(motion["ctrl"]) - 1):
        for i in range(decimation):
            past = np.concatenate([motion["ctrl"][k][None], past[:-1]])
            target = (weights * past).sum(0) + offset
            desired.FixValue(context, np.concatenate([target, np.zeros(len(names))]))
            forces.FixValue(context, robot_cfg.friction(plant, context, target))
            simulator.AdvanceTo(
                (k * decimation + i + 0.5) * check.step
            )  # one discrete step, despite rounding
        path.append(plant.GetPositions(context)[at])
    paths.append(np.array(path))
check.report_motions("Drake", paths)
