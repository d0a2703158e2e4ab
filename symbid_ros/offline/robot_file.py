"""Robot files: model, topics and options of one robot, as a ROS parameter file.

The commands read them with ``--robot``, the node `identifier` with ``--params-file``.
"""

from collections.abc import Iterable, Mapping
from difflib import get_close_matches
from pathlib import Path
from typing import Any, get_args

from symbid_ros.choices import Base
from symbid_ros.errors import OptionError
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.options import Option, options_of, spelled
from symbid_ros.user_files import load_yaml

NODES = "/**", "identifier", "/identifier"
PARAMETERS = "ros__parameters"
# Parameters of the node that no command needs.
OF_THE_NODE = (
    "bag",
    "imu_topics",
    "lag",
    "live_model",
    "memory",
    "mode",
    "out",
    "overwrite",
    "queue_depth",
    "resume",
    "robot_description",
    "row_share",
    "save_time",
    "settle",
    "solve_period",
    "use_sim_time",
    "wrench_topics",
)


def load_robot_file(path: Path) -> dict[str, Any]:
    """Return the parameters of a robot file.

    A relative path in it starts at the folder of the file. Parameters that are empty, as ROS
    writes unset ones, are left out.

    Raises
    ------
    OptionError
        When the file is missing or invalid, or has an unknown parameter or a value of the wrong
        type.
    """
    try:
        content = load_yaml(path)
    except OSError as error:
        raise OptionError(f"{path}: {error.strerror}; give an existing `robot` file", "E540") from (
            None
        )
    except ValueError as error:
        raise OptionError(f"{path}: {error}", "E540") from None
    values: dict[str, Any] = {}
    for node, entry in _mapping(path, "the file", content).items():
        if node not in NODES:
            raise OptionError(
                f"{path}: {node!r} is not a node of a robot file; write the parameters below "
                f"'{NODES[0]}' and '{PARAMETERS}'",
                "E540",
            )
        inner = _mapping(path, node, entry)
        values |= _mapping(path, PARAMETERS, inner.get(PARAMETERS))
    options = {
        each.name: each for kind in (IdentifyOptions, LogOptions) for each in options_of(kind)
    }
    _require_known(path, values, (*options, "model", "base", *OF_THE_NODE))
    found: dict[str, Any] = {}
    for name, value in values.items():
        if name in OF_THE_NODE or value in ("", [""], [], None):
            continue
        if name in options:
            _require_type(path, options[name], value)
        elif name == "base" and value not in get_args(Base):
            raise _not_valid(path, name, value, f"one of {', '.join(get_args(Base))}")
        elif name == "model" and not isinstance(value, str):
            raise _not_valid(path, name, value, "the path of a model file")
        is_path = name == "model" or (name in options and options[name].kind is Path)
        found[name] = _placed(path.parent, value) if is_path else value
    return found


def _require_type(path: Path, option: Option, value: Any) -> None:
    try:
        option.value_of(value)
    except OptionError as error:
        # In the file, options have their own names and not those of flags.
        raise OptionError(f"{path}: {spelled(str(error), str)}", "E540") from None


def _not_valid(path: Path, name: str, value: Any, expected: str) -> OptionError:
    return OptionError(f"{path}: {name}: {value!r} is not valid; give {expected}", "E540")


def _placed(folder: Path, value: Any) -> Any:
    if isinstance(value, list):
        return [_placed(folder, one) for one in value]
    return folder / value if isinstance(value, str) else value


def _mapping(path: Path, what: str, content: Any) -> Mapping[str, Any]:
    if isinstance(content, dict) and all(isinstance(key, str) for key in content):
        return content
    raise OptionError(
        f"{path}: {what} is not a mapping of names to values; write one with `symbid init`", "E540"
    )


def _require_known(path: Path, values: Iterable[str], known: tuple[str, ...]) -> None:
    for name in values:
        if name not in known:
            similar = get_close_matches(name, known, 1)
            hint = f"; did you mean {similar[0]}?" if similar else "; remove it"
            raise OptionError(f"{path}: there is no parameter {name}{hint}", "E540")
