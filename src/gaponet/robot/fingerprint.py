"""Fingerprint of a compiled model: lines of rounded numbers.

Two models with equal lines have equal dynamics.

The lines do not depend on how a model was written. Bodies welded together are one link, inertias
are tensors about the link's centre, and positions are those of the reference pose. Comments, file
names, geoms without contact, sites, cameras and sensors are ignored. Rounding steps are far below
any physical effect and far above the differences between compilers. They are no decimal fractions,
because a number from a file could lie half way between two of those.
"""

from __future__ import annotations

from collections.abc import Iterator

import mujoco
import numpy as np

from gaponet.base.arrays import Array

NO_DECIMAL = 1.0471975511965976
# m, kg, kg·m²
LENGTH_STEP = 1e-7 * NO_DECIMAL
MASS_STEP = 1e-7 * NO_DECIMAL
INERTIA_STEP = 1e-11 * NO_DECIMAL
MESH_STEP = 1e-4 * NO_DECIMAL  # m, of the extent of a mesh
JOINT_FIELDS = ("solref", "solimp", "margin", "actgravcomp")
DOF_FIELDS = ("armature", "frictionloss", "solref", "solimp")
ACTUATOR_FIELDS = (
    "trntype",
    "gear",
    "gaintype",
    "gainprm",
    "biastype",
    "biasprm",
    "dyntype",
    "dynprm",
    "armature",
    "damping",
    "dampingpoly",
    "delay",
    "history",
    "user",
)
OPTIONS = (
    "integrator",
    "cone",
    "solver",
    "gravity",
    "wind",
    "density",
    "viscosity",
    "impratio",
    "iterations",
    "tolerance",
    "ls_iterations",
    "ls_tolerance",
    "noslip_iterations",
    "noslip_tolerance",
    "ccd_iterations",
    "ccd_tolerance",
)
IGNORED_FLAGS = {
    "mjDSBL_WARMSTART",
    "mjDSBL_SENSOR",
    "mjDSBL_MIDPHASE",
    "mjDSBL_AUTORESET",
    "mjDSBL_ISLAND",
}
GEOM_FIELDS = (
    "type",
    "contype",
    "conaffinity",
    "condim",
    "priority",
    "friction",
    "margin",
    "gap",
    "solref",
    "solimp",
    "solmix",
    "fluid",
)


def _bodies_with_joint(model: mujoco.MjModel) -> list[int]:
    bodies = []
    for body in range(1, model.nbody):
        if model.body_weldid[body] == body and model.body_jntnum[body]:
            bodies.append(body)
    return bodies


def model_fingerprint(model: mujoco.MjModel) -> Iterator[str]:
    """Yield what determines the dynamics of a model, one item per line, without the time step."""
    data = mujoco.MjData(model)
    data.qpos[:] = model.qpos0
    mujoco.mj_kinematics(model, data)
    roots = _bodies_with_joint(model)  # others are welded to one of them, or to the world
    link = {}
    for body, root in enumerate(model.body_weldid.tolist()):
        link[body] = roots.index(root) + 1 if root in roots else 0
    yield from _options(model)
    for number, root in enumerate(roots, 1):
        parent = link[int(model.body_parentid[root])]
        yield f"link {number} on {parent}{_inertia(model, data, root)}"
    for j in range(model.njnt):
        yield from _joint(model, data, j, link)
    yield from _actuators(model)
    yield from _mounts(model, data, link)
    if model.neq or model.ntendon:
        yield from _couplings(model, data, link)
    touching = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT
    if touching or model.opt.density or model.opt.viscosity:
        yield from _geoms(model, data, link, touching)


def _actuators(model: mujoco.MjModel) -> Iterator[str]:
    for i in range(model.nu):
        joint = model.joint(model.actuator_trnid[i, 0]).name
        fields = _fields(model, "actuator", ACTUATOR_FIELDS, i)
        limits = [_range(model, "actuator", kind, i) for kind in ("force", "ctrl", "act")]
        yield f"actuator of {joint} {fields} {' '.join(limits)}"


def _mounts(model: mujoco.MjModel, data: mujoco.MjData, link: dict[int, int]) -> Iterator[str]:
    """Yield the bodies of payloads."""
    for body in range(1, model.nbody):
        name = model.body(body).name
        if name.startswith("payload_"):
            yield f"mount {name} on {link[body]} at {_rounded(data.xpos[body], LENGTH_STEP)}"


def _options(model: mujoco.MjModel) -> Iterator[str]:
    for name in OPTIONS:
        yield f"{name} {_exact(getattr(model.opt, name))}"
    for kind, flags in (
        (mujoco.mjtDisableBit, "disableflags"),
        (mujoco.mjtEnableBit, "enableflags"),
    ):
        names = set()
        for bit in kind.__members__.values():
            is_flag = "BL_" in bit.name  # not the count of flags
            if is_flag and getattr(model.opt, flags) & bit.value:
                names.add(bit.name)
        yield f"{flags} {' '.join(sorted(names - IGNORED_FLAGS))}"
    if model.opt.enableflags & mujoco.mjtEnableBit.mjENBL_OVERRIDE:
        fields = ("o_margin", "o_solref", "o_solimp", "o_friction")
        yield " ".join(_exact(getattr(model.opt, field)) for field in fields)


def _inertia(model: mujoco.MjModel, data: mujoco.MjData, root: int) -> str:
    """Return mass, centre, inertia tensor and gravity compensation of the bodies welded to a
    body.
    """
    bodies = np.flatnonzero(model.body_weldid == root)
    mass = model.body_mass[bodies]
    centre = data.xipos[bodies]
    rotation = data.ximat[bodies].reshape(-1, 3, 3)
    inertia = rotation @ (model.body_inertia[bodies, :, None] * rotation.mT)
    total = mass.sum()
    middle = mass @ centre / max(total, mujoco.mjMINVAL)
    arm = centre - middle
    inertia += mass[:, None, None] * (
        (arm**2).sum(1)[:, None, None] * np.eye(3) - arm[:, :, None] * arm[:, None, :]
    )
    tensor = inertia.sum(axis=0)[np.triu_indices(3)]
    compensated = mass * model.body_gravcomp[bodies]
    return (
        f": {_rounded(total, MASS_STEP)} at {_rounded(middle, LENGTH_STEP)} inertia "
        f"{_rounded(tensor, INERTIA_STEP)} gravcomp {_rounded(compensated.sum(), MASS_STEP)} at "
        f"{_rounded(compensated @ centre, LENGTH_STEP)}"
    )


def _joint(
    model: mujoco.MjModel, data: mujoco.MjData, j: int, link: dict[int, int]
) -> Iterator[str]:
    dof = int(model.jnt_dofadr[j])
    at = int(model.jnt_qposadr[j])
    yield (
        f"joint {model.joint(j).name} of {link[int(model.jnt_bodyid[j])]} type {model.jnt_type[j]} "
        f"axis {_rounded(data.xaxis[j], LENGTH_STEP)} at {_rounded(data.xanchor[j], LENGTH_STEP)}"
    )
    springs = [model.jnt_stiffness[j], *np.ravel(_row(model, "jnt_stiffnesspoly", j))]
    dampers = [model.dof_damping[dof], *np.ravel(_row(model, "dof_dampingpoly", dof))]
    rest = model.qpos_spring[at] if any(springs) else 0.0
    spring = f"spring {_exact(springs)} at {_exact(rest)}"
    yield f"ref {_exact(model.qpos0[at])} {spring} damping {_exact(dampers)}"
    yield _fields(model, "jnt", JOINT_FIELDS, j)
    yield _fields(model, "dof", DOF_FIELDS, dof)
    limits = f"{_exact(model.jnt_range[j])}" if model.jnt_limited[j] else "none"
    yield f"range {limits} {_range(model, 'jnt', 'actfrc', j)}"


def _couplings(model: mujoco.MjModel, data: mujoco.MjData, link: dict[int, int]) -> Iterator[str]:
    """Yield equality constraints, tendons and sites, which they may refer to."""
    for s in range(model.nsite):
        place = _rounded(data.site_xpos[s], LENGTH_STEP)
        yield f"site {s} on {link[int(model.site_bodyid[s])]} at {place}"
    for name in ("type", "obj1id", "obj2id", "objtype", "active0", "solref", "solimp", "data"):
        yield f"equality {name} {_exact(getattr(model, f'eq_{name}'))}"
    names = (
        "adr",
        "num",
        "limited",
        "range",
        "margin",
        "stiffness",
        "damping",
        "frictionloss",
        "armature",
        "lengthspring",
        "solref_lim",
        "solimp_lim",
        "solref_fri",
        "solimp_fri",
    )
    for name in names:
        yield f"tendon {name} {_exact(getattr(model, f'tendon_{name}'))}"
    yield f"wrap {_exact(model.wrap_type)} {_exact(model.wrap_objid)} {_exact(model.wrap_prm)}"


def _geoms(
    model: mujoco.MjModel, data: mujoco.MjData, link: dict[int, int], touching: bool
) -> Iterator[str]:
    """Yield geoms that can collide or interact with a fluid; a mesh by the mean and extent of its
    vertices.
    """
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    for g in range(model.ngeom):
        collides = touching and (model.geom_contype[g] or model.geom_conaffinity[g] or g in paired)
        if not collides and not model.geom_fluid[g].any():
            continue
        position = data.geom_xpos[g]
        rotation = data.geom_xmat[g].reshape(3, 3)
        text = _fields(model, "geom", GEOM_FIELDS, g)
        if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_MESH:
            mesh = int(model.geom_dataid[g])
            start = int(model.mesh_vertadr[mesh])
            count = int(model.mesh_vertnum[mesh])
            v = position + model.mesh_vert[start : start + count].astype(float) @ rotation.T
            shape = (
                f"{count} vertices "
                f"{_rounded([v.mean(axis=0), v.min(axis=0), v.max(axis=0)], MESH_STEP)}"
            )
        else:
            frame = f"{_rounded(position, LENGTH_STEP)} {_rounded(rotation, LENGTH_STEP)}"
            shape = f"{_exact(model.geom_size[g])} at {frame}"
        yield f"geom on {link[int(model.geom_bodyid[g])]} {text} {shape}"
    if touching:
        yield f"exclude {_exact(model.exclude_signature)}"
        for name in (
            "signature",
            "dim",
            "friction",
            "margin",
            "gap",
            "solref",
            "solreffriction",
            "solimp",
        ):
            yield f"pair {name} {_exact(getattr(model, f'pair_{name}'))}"


def _range(model: mujoco.MjModel, prefix: str, kind: str, i: int) -> str:
    limited = getattr(model, f"{prefix}_{kind}limited")[i]
    return f"{kind} {_exact(getattr(model, f'{prefix}_{kind}range')[i]) if limited else 'free'}"


def _fields(model: mujoco.MjModel, kind: str, names: tuple[str, ...], i: int) -> str:
    """Return fields of element i of a kind; an array that this version of MuJoCo lacks counts as
    zeros.
    """
    return " ".join(f"{name} {_exact(_row(model, f'{kind}_{name}', i))}" for name in names)


def _row(model: mujoco.MjModel, name: str, i: int) -> Array:
    """Return a row of an array; empty if this version of MuJoCo lacks the array."""
    values = getattr(model, name, None)
    return np.zeros(0) if values is None else np.asarray(values[i])


def _exact(values: object) -> str:
    """Format numbers with seven digits, without trailing zeros: their count differs between
    versions of MuJoCo.
    """
    texts = [f"{number + 0.0:.7g}" for number in np.ravel(np.asarray(values, float))]
    while texts and texts[-1] == "0":
        texts.pop()
    return " ".join(texts) or "0"


def _rounded(values: object, step: float) -> str:
    """Format computed numbers in whole steps."""
    return " ".join(str(int(x)) for x in np.round(np.ravel(np.asarray(values, float)) / step))
