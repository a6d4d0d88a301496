"""Masses, centres of mass and inertias of the links, with the servos."""

from __future__ import annotations

from dataclasses import replace

from gaponet.sysid.steps.link_fit import LinkFit
from gaponet.sysid.steps.step import Fits, FitState
from gaponet.sysid.steps.torque_fit import TorqueFit

ONE_PAYLOAD = (
    "masses and gains are known up to a common factor: record two payloads before you trust a third"
)


class LinkMasses:
    """Fit of the links; gains that follow from recorded torque hold."""

    name = "masses"

    def __init__(self, fits: Fits) -> None:
        self._fits = fits
        # Of each set of recordings: joint → kp from torque, N·m/rad, and its standard error.
        self._torque_gains: list[dict[str, tuple[float, float]]] = []
        for recordings in fits.recordings:
            known = TorqueFit(recordings, fits.joints[0].robot).known
            self._torque_gains.append({joint: (g.kp, g.error) for joint, g in known.items()})

    def applies(self, state: FitState) -> bool:
        """Return True."""
        return True

    def propose(self, state: FitState) -> FitState:
        """Return the state with links; the same state if no link changes."""
        progress = self._fits.progress
        fits = []
        results = []
        for robot, base, gains in zip(state.robots, state.base, self._torque_gains, strict=True):
            progress.begin_search()
            fit = LinkFit(robot, base, gains)
            rows = robot.rollouts.rows.sum(keepdims=True)
            report = progress.reporter(self.name, ("all joints",), rows)
            fits.append(fit)
            results.append(fit.descend(report))
        if not results[-1].x.any():
            return state
        values = [result.values for result in results]
        return replace(
            state,
            values=values,
            base=values,
            links=[result.axes.links(result.x) for result in results],
            link_fit=(fits[-1], results[-1]),
        )

    def warnings(self, state: FitState) -> list[str]:
        """Return a warning if links were accepted and nothing tells masses from gains."""
        if not state.links or not self._fits.given.payload_mounts:
            return []
        payloads = {s.meta.payload_mass for s in self._fits.recordings[-1]}
        gains_are_known = bool(self._torque_gains[-1])
        if gains_are_known or len(payloads) > 1:
            return []
        return [ONE_PAYLOAD]
