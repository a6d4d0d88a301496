"""The part that shows and proves: reports, figures, views, studies over many trainings, speed.

What it offers to gaponet (gaponet.parts); nothing is imported here.
"""

COMMANDS = {
    name: f"gaponet_lab.cli.{name}:{name}" for name in ("view", "report", "experiment", "runs", "demo", "bench")
} | {name: f"gaponet_lab.cli.known:{name}" for name in ("show", "check", "fleet")}
PROVIDES = {
    "what is known of a robot": "gaponet_lab.known.evidence:known",
    "what recordings say": "gaponet_lab.known.evidence:evidence",
    "servos' own ramps": "gaponet_lab.known.ramps:with_ramps",
    "identification from torque": "gaponet_lab.known.torque:rival",
    "figure of a gap": "gaponet_lab.report.gap_figure:write_gap",
    "figure of a replay": "gaponet_lab.report.replay_figure:write",
    "figures of a dataset": "gaponet_lab.report.draw_dataset:draw_all",
    "figures of findings": "gaponet_lab.report.draw_findings:draw_findings",
    "picture of models": "gaponet_lab.view.still:still",
    "labels of logs": "gaponet_lab.real.labels:estimate",
    "labels to logs.toml": "gaponet_lab.real.labels:write",
    "OpenGL": "gaponet_lab.view.portrait:prepare",
}
