"""Play the motions of check.npz in a few worlds of mjlab, and print the error beside gaponet's.

    python check.py
    python check.py randomization.json ROW  # the same with a unit of the file

`gaponet export ROBOT --to randomization` writes the file; a unit is a row of it.

In an export of actuator networks mjlab's learned actuators play them.
"""

import dataclasses
import sys
from pathlib import Path

import gaponet_action as gaponet
from mjlab.entity import EntityArticulationInfoCfg
from mjlab.envs import ManagerBasedRlEnv, ManagerBasedRlEnvCfg
from mjlab.envs.mdp.actions import JointPositionActionCfg
from mjlab.managers.event_manager import EventTermCfg
from mjlab.scene import SceneCfg
from mjlab.sim import SimulationCfg

from gaponet.export.shipped.mujoco_servos import Check

HERE = Path(__file__).parent
check = Check(HERE)
networks = "actuator_net" in check.facts
joints = {"entity_name": "robot", "actuator_names": (".*",)}
if networks:
    from actuators import mjlab_actuators

    entity = gaponet.mjlab_entity(
        HERE, articulation=EntityArticulationInfoCfg(actuators=mjlab_actuators(HERE))
    )
else:
    entity = gaponet.mjlab_entity(HERE)
action = JointPositionActionCfg(**joints, use_default_offset=False)
options, decimation = gaponet.mjlab_options(HERE)
step = check.facts["actuator_net"]["step"] if networks else check.step
player = gaponet.CheckPlayer(check)
events = gaponet.mjlab_events(HERE)
events["start"] = EventTermCfg(func=player.reset_event(), mode="reset")
if sys.argv[1:]:
    unit = gaponet.mjlab_units(sys.argv[1], rows=[int(sys.argv[2])] * check.worlds)
    events = {"unit": EventTermCfg(func=unit, mode="reset")} | events
cfg = ManagerBasedRlEnvCfg(
    decimation=decimation,
    scene=SceneCfg(num_envs=check.worlds, entities={"robot": entity}),
    actions={"joint_pos": action},
    events=events,
    sim=SimulationCfg(mujoco=dataclasses.replace(options, timestep=step)),
)
env = ManagerBasedRlEnv(cfg, device="cpu")
path = player.run(env, env.action_manager.get_term("joint_pos").target_names)
form, what = ("actuator networks", "'s learned actuators") if networks else ("joints", "")
check.report(f"mjlab{what}", path, form)
