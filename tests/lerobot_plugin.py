"""The LeRobot plug-in, on LeRobot where it is installed, otherwise on stand-ins for its classes."""

from __future__ import annotations

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

NAME = "lerobot_robot_gaponet"
PACKAGE = Path(__file__).parents[1] / "plugins" / NAME / NAME


class Base:
    """What LeRobot's classes and registries have in common."""

    def __init__(self, config: object = None) -> None:
        self.config = config

    @classmethod
    def register_subclass(cls, name: str):
        return lambda made: made

    register = register_subclass


class TeleoperatorConfig(Base):
    __init__ = object.__init__


@dataclass(kw_only=True)
class RobotConfig(Base):
    id: str | None = None
    calibration_dir: Path | None = None


class Robot(Base):
    def __init__(self, config: RobotConfig) -> None:
        folder = config.calibration_dir or Path()
        self.calibration_fpath = folder / self.name / f"{config.id}.json"


def make_robot_from_config(config: RobotConfig) -> Robot:
    """Return the robot of the same name without Config, as LeRobot does for robots that are not its
    own.
    """
    module = sys.modules[type(config).__module__]
    return getattr(module, type(config).__name__.removesuffix("Config"))(config)


STAND_INS = {
    "lerobot": {},
    "lerobot.cameras": {"CameraConfig": object, "make_cameras_from_configs": lambda configs: {}},
    "lerobot.lerobot_types": {
        "EnvTransition": dict,
        "TransitionKey": SimpleNamespace(ACTION="action", OBSERVATION="observation"),
    },
    "lerobot.processor": {"ProcessorStep": Base, "ProcessorStepRegistry": Base},
    "lerobot.robots": {
        "Robot": Robot,
        "RobotConfig": RobotConfig,
        "make_robot_from_config": make_robot_from_config,
    },
    "lerobot.teleoperators": {"Teleoperator": Base, "TeleoperatorConfig": TeleoperatorConfig},
    "lerobot.utils": {},
    "lerobot.utils.errors": {"DeviceNotConnectedError": ConnectionError},
}


def import_plugin(monkeypatch, stand_ins):
    """Import the plug-in with stand-ins for LeRobot's modules: name → what it holds."""
    for name, holds in stand_ins.items():
        module = ModuleType(name)
        vars(module).update(holds)
        monkeypatch.setitem(sys.modules, name, module)
    spec = importlib.util.spec_from_file_location(
        NAME, PACKAGE / "__init__.py", submodule_search_locations=[str(PACKAGE)]
    )
    module = importlib.util.module_from_spec(spec)
    sys.modules[NAME] = module
    spec.loader.exec_module(module)
    return module


def forget_plugin():
    """Let the next test import the plug-in anew."""
    for name in [name for name in sys.modules if name.split(".")[0] == NAME]:
        del sys.modules[name]


@pytest.fixture
def plugin(monkeypatch):
    """The plug-in on stand-ins."""
    pytest.importorskip("torch")
    yield import_plugin(monkeypatch, STAND_INS)
    forget_plugin()


@pytest.fixture
def lerobot_plugin(monkeypatch):
    """The plug-in on LeRobot where it is installed, otherwise on stand-ins."""
    pytest.importorskip("torch")
    installed = importlib.util.find_spec("lerobot") is not None
    yield import_plugin(monkeypatch, {} if installed else STAND_INS)
    forget_plugin()
