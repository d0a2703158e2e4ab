"""Identification of inertial and friction parameters of robots, in Python and on ROS 2.

    import symbid_ros as sy

    robot = sy.load_model("my_robot.urdf")
    log = sy.load_bag("my_bag", robot)
    result = sy.identify(robot, log)

The names below are the public API; everything else is private. They are imported when they are
first used, so that the import of this package needs NumPy alone.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from symbid_ros.choices import METHODS as METHODS
    from symbid_ros.diagnosis.findings import Diagnosis as Diagnosis
    from symbid_ros.dynamics.imu import BaseMotion as BaseMotion
    from symbid_ros.errors import BagError as BagError
    from symbid_ros.errors import DataError as DataError
    from symbid_ros.errors import EstimateError as EstimateError
    from symbid_ros.errors import ModelError as ModelError
    from symbid_ros.errors import OptionError as OptionError
    from symbid_ros.errors import PriorError as PriorError
    from symbid_ros.errors import SymbidError as SymbidError
    from symbid_ros.estimation.model_gate import CandidateModel as CandidateModel
    from symbid_ros.estimation.model_gate import ModelGate as ModelGate
    from symbid_ros.identification.api import diagnose as diagnose
    from symbid_ros.identification.api import identify as identify
    from symbid_ros.identification.api import merge as merge
    from symbid_ros.identification.api import regressor as regressor
    from symbid_ros.identification.options import IdentifyOptions as IdentifyOptions
    from symbid_ros.identification.predictions.evaluation import Metrics as Metrics
    from symbid_ros.identification.predictions.force_errors import ForceError as ForceError
    from symbid_ros.identification.predictions.validation import validate as validate
    from symbid_ros.identification.predictions.validation_result import Validation as Validation
    from symbid_ros.identification.result import ForcePrediction as ForcePrediction
    from symbid_ros.identification.result import LinkEstimate as LinkEstimate
    from symbid_ros.identification.result import LogInformation as LogInformation
    from symbid_ros.identification.result import ParameterEstimate as ParameterEstimate
    from symbid_ros.identification.result import Result as Result
    from symbid_ros.messages.log_options import LogOptions as LogOptions
    from symbid_ros.model.load import load_model as load_model
    from symbid_ros.model.tree import RobotModel as RobotModel
    from symbid_ros.offline.bags import evaluate as evaluate
    from symbid_ros.offline.bags import load_bag as load_bag
    from symbid_ros.signals.log import Log as Log

# Where each public name is defined.
_MODULES = {
    "BagError": "errors",
    "BaseMotion": "dynamics.imu",
    "CandidateModel": "estimation.model_gate",
    "DataError": "errors",
    "Diagnosis": "diagnosis.findings",
    "EstimateError": "errors",
    "ForceError": "identification.predictions.force_errors",
    "ForcePrediction": "identification.result",
    "IdentifyOptions": "identification.options",
    "LinkEstimate": "identification.result",
    "Log": "signals.log",
    "LogInformation": "identification.result",
    "LogOptions": "messages.log_options",
    "METHODS": "choices",
    "Metrics": "identification.predictions.evaluation",
    "ModelError": "errors",
    "ModelGate": "estimation.model_gate",
    "OptionError": "errors",
    "ParameterEstimate": "identification.result",
    "PriorError": "errors",
    "Result": "identification.result",
    "RobotModel": "model.tree",
    "SymbidError": "errors",
    "Validation": "identification.predictions.validation_result",
    "diagnose": "identification.api",
    "evaluate": "offline.bags",
    "identify": "identification.api",
    "load_bag": "offline.bags",
    "load_model": "model.load",
    "merge": "identification.api",
    "regressor": "identification.api",
    "validate": "identification.predictions.validation",
}
__all__ = sorted([*_MODULES, "__version__"])  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("symbid_ros.package_paths").package_version()
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"{__name__}.{_MODULES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
