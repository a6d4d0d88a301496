"""What a compiled model simulates, in lines of rounded numbers: two models with the same lines move the same.

The lines do not depend on how a model was written: bodies welded together are one link, inertias are tensors about the
link's centre, and all places are those of the reference pose. Comments, file names, geoms that touch nothing, sites,
cameras and sensors leave no trace. Numbers are rounded far below what matters and far above what two compilers differ
by; steps are no decimal fractions, since a figure from a file could lie half way between two of those.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from gaponet.base.arrays import Array

ODD = 1.0471975511965976
LENGTH, MASS, INERTIA, HULL = 1e-7 * ODD, 1e-7 * ODD, 1e-11 * ODD, 1e-4 * ODD  # m, kg, kg·m², m of a mesh that touches
JOINT = ("solref", "solimp", "margin", "actgravcomp")
DOF = ("armature", "frictionloss", "solref", "solimp")
ACTUATOR = (
    "trntype", "gear", "gaintype", "gainprm", "biastype", "biasprm", "dyntype", "dynprm", "armature", "damping",
    "dampingpoly", "delay", "history", "user",
)  # fmt: skip
OPTION = (
    "integrator", "cone", "solver", "gravity", "wind", "density", "viscosity", "impratio", "iterations", "tolerance",
    "ls_iterations", "ls_tolerance", "noslip_iterations", "noslip_tolerance", "ccd_iterations", "ccd_tolerance",
)  # fmt: skip
IDLE_FLAGS = {"mjDSBL_WARMSTART", "mjDSBL_SENSOR", "mjDSBL_MIDPHASE", "mjDSBL_AUTORESET", "mjDSBL_ISLAND"}
GEOM = ("type", "contype", "conaffinity", "condim", "priority", "friction", "margin", "gap", "solref", "solimp",
        "solmix", "fluid")  # fmt: skip


def model_fingerprint(model: mujoco.MjModel) -> Iterator[str]:
    """Everything that decides how the model moves, one thing per line; the time step is left to the caller."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    roots = [b for b in range(1, model.nbody) if model.body_weldid[b] == b and model.body_jntnum[b]]
    link = {b: roots.index(root) + 1 if root in roots else 0 for b, root in enumerate(model.body_weldid.tolist())}
    yield from _options(model)
    for number, root in enumerate(roots, 1):
        yield f"link {number} on {link[int(model.body_parentid[root])]}" + _inertia(model, data, root)
    for j in range(model.njnt):
        yield from _joint(model, data, j, link)
    for i in range(model.nu):
        text = " ".join(f"{f} {_exact(getattr(model, f'actuator_{f}', np.zeros(model.nu))[i])}" for f in ACTUATOR)
        limits = [_range(model, "actuator", kind, i) for kind in ("force", "ctrl", "act")]
        yield f"actuator of {model.joint(model.actuator_trnid[i, 0]).name} {text} {' '.join(limits)}"
    for body in range(1, model.nbody):
        if model.body(body).name.startswith("payload_"):
            yield f"mount {model.body(body).name} on {link[body]} at {_near(data.xpos[body], LENGTH)}"
    if model.neq or model.ntendon:
        yield from _couplings(model, data, link)
    touching = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    if touching or model.opt.density or model.opt.viscosity:
        yield from _geoms(model, data, link, touching)


def _options(model: mujoco.MjModel) -> Iterator[str]:
    for name in OPTION:
        yield f"{name} {_exact(getattr(model.opt, name))}"
    for kind, flags in ((mujoco.mjtDisableBit, "disableflags"), (mujoco.mjtEnableBit, "enableflags")):
        bits = [bit for bit in kind.__members__.values() if "BL_" in bit.name]  # not their number
        names = {bit.name for bit in bits if getattr(model.opt, flags) & bit.value}
        yield f"{flags} {' '.join(sorted(names - IDLE_FLAGS))}"
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
        yield " ".join(_exact(getattr(model.opt, f)) for f in ("o_margin", "o_solref", "o_solimp", "o_friction"))


def _inertia(model: mujoco.MjModel, data: mujoco.MjData, root: int) -> str:
    """Mass, centre and tensor about it of everything welded to a body, and what of its weight is taken off it."""
    part = np.flatnonzero(model.body_weldid == root)
    mass, centre = model.body_mass[part], data.xipos[part]
    turn = data.ximat[part].reshape(-1, 3, 3)
    own = turn @ (model.body_inertia[part, :, None] * turn.mT)
    total = mass.sum()
    middle = mass @ centre / max(total, mujoco.mjMINVAL)
    away = centre - middle
    own += mass[:, None, None] * ((away**2).sum(1)[:, None, None] * np.eye(3) - away[:, :, None] * away[:, None, :])
    tensor = own.sum(axis=0)[np.triu_indices(3)]
    lifted = mass * model.body_gravcomp[part]
    return (
        f": {_near(total, MASS)} at {_near(middle, LENGTH)} inertia {_near(tensor, INERTIA)} "
        f"gravcomp {_near(lifted.sum(), MASS)} at {_near(lifted @ centre, LENGTH)}"
    )


def _joint(model: mujoco.MjModel, data: mujoco.MjData, j: int, link: dict[int, int]) -> Iterator[str]:
    dof, at = int(model.jnt_dofadr[j]), int(model.jnt_qposadr[j])
    yield (
        f"joint {model.joint(j).name} of {link[int(model.jnt_bodyid[j])]} type {model.jnt_type[j]} "
        f"axis {_near(data.xaxis[j], LENGTH)} at {_near(data.xanchor[j], LENGTH)}"
    )
    springs = [model.jnt_stiffness[j], *np.ravel(_of(model, "jnt_stiffnesspoly", j))]
    dampers = [model.dof_damping[dof], *np.ravel(_of(model, "dof_dampingpoly", dof))]
    rest = model.qpos_spring[at] if any(springs) else 0.0
    yield f"ref {_exact(model.qpos0[at])} spring {_exact(springs)} at {_exact(rest)} damping {_exact(dampers)}"
    yield " ".join(f"{f} {_exact(getattr(model, f'jnt_{f}')[j])}" for f in JOINT)
    yield " ".join(f"{f} {_exact(getattr(model, f'dof_{f}')[dof])}" for f in DOF)
    limits = f"{_exact(model.jnt_range[j])}" if model.jnt_limited[j] else "none"
    yield f"range {limits} {_range(model, 'jnt', 'actfrc', j)}"


def _couplings(model: mujoco.MjModel, data: mujoco.MjData, link: dict[int, int]) -> Iterator[str]:
    """Equality constraints and tendons, as they are stored, with the sites that they may hang on."""
    for s in range(model.nsite):
        yield f"site {s} on {link[int(model.site_bodyid[s])]} at {_near(data.site_xpos[s], LENGTH)}"
    for name in ("type", "obj1id", "obj2id", "objtype", "active0", "solref", "solimp", "data"):
        yield f"equality {name} {_exact(getattr(model, f'eq_{name}'))}"
    names = ("adr", "num", "limited", "range", "margin", "stiffness", "damping", "frictionloss", "armature",
             "lengthspring", "solref_lim", "solimp_lim", "solref_fri", "solimp_fri")  # fmt: skip
    for name in names:
        yield f"tendon {name} {_exact(getattr(model, f'tendon_{name}'))}"
    yield f"wrap {_exact(model.wrap_type)} {_exact(model.wrap_objid)} {_exact(model.wrap_prm)}"


def _geoms(model: mujoco.MjModel, data: mujoco.MjData, link: dict[int, int], touching: bool) -> Iterator[str]:
    """Geoms that may touch or feel the medium; of a mesh the middle and the extent of its vertices."""
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    for g in range(model.ngeom):
        meets = touching and (model.geom_contype[g] or model.geom_conaffinity[g] or g in paired)
        if not meets and not model.geom_fluid[g].any():
            continue
        place, turn = data.geom_xpos[g], data.geom_xmat[g].reshape(3, 3)
        text = " ".join(f"{f} {_exact(getattr(model, f'geom_{f}')[g])}" for f in GEOM)
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = int(model.geom_dataid[g])
            start, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            v = place + model.mesh_vert[start : start + count].astype(float) @ turn.T
            shape = f"{count} vertices {_near([v.mean(axis=0), v.min(axis=0), v.max(axis=0)], HULL)}"
        else:
            shape = f"{_exact(model.geom_size[g])} at {_near(place, LENGTH)} {_near(turn, LENGTH)}"
        yield f"geom on {link[int(model.geom_bodyid[g])]} {text} {shape}"
    if touching:
        yield f"exclude {_exact(model.exclude_signature)}"
        for name in ("signature", "dim", "friction", "margin", "gap", "solref", "solreffriction", "solimp"):
            yield f"pair {name} {_exact(getattr(model, f'pair_{name}'))}"


def _range(model: mujoco.MjModel, of: str, kind: str, i: int) -> str:
    limited = getattr(model, f"{of}_{kind}limited")[i]
    return f"{kind} {_exact(getattr(model, f'{of}_{kind}range')[i]) if limited else 'free'}"


def _of(model: mujoco.MjModel, name: str, i: int) -> Array:
    """A row of an array that older versions lack."""
    found = getattr(model, name, None)
    return np.zeros(0) if found is None else np.asarray(found[i])


def _exact(values: object) -> str:
    """Figures as files have them, seven digits; zeros at the end, more or fewer by version, do not count."""
    texts = [f"{x + 0.0:.7g}" for x in np.ravel(np.asarray(values, float))]
    while texts and texts[-1] == "0":
        texts.pop()
    return " ".join(texts) or "0"


def _near(values: object, step: float) -> str:
    """Computed figures in whole steps."""
    return " ".join(str(int(x)) for x in np.round(np.ravel(np.asarray(values, float)) / step))
