"""Options of recording and replay, and the parameters generated from them."""

from pathlib import Path
from typing import Any

import pytest

from symbid_ros.errors import OptionError
from symbid_ros.ros.parameters import ParameterError, options_from, parameters_of
from symbid_ros.ros.player import PlayOptions
from symbid_ros.ros.recorder import RecordOptions


def values(kind: type, **given: Any) -> dict[str, Any]:
    return {each.name: each.default for each in parameters_of(kind)} | given


def test_default_parameters_give_the_default_options() -> None:
    assert options_from(RecordOptions, values(RecordOptions)) == RecordOptions()
    options = options_from(PlayOptions, values(PlayOptions, bag=["log"]))
    assert options == PlayOptions(bag=(Path("log"),))


@pytest.mark.parametrize(
    ("kind", "given", "code", "name"),
    [
        (RecordOptions, {"topics_regex": "("}, "E501", "topics_regex"),
        (RecordOptions, {"exclude_regex": "["}, "E501", "exclude_regex"),
        (PlayOptions, {}, "E501", "bag"),
        (PlayOptions, {"bag": ["a"], "publish_clock": True, "topics": ["clock"]}, "E502", "topics"),
    ],
)
def test_errors_name_the_option_and_the_parameter(kind, given, code: str, name: str) -> None:
    with pytest.raises(OptionError, match=f"^`{name}`") as option_error:
        kind(**given)
    with pytest.raises(ParameterError, match=f"^parameter {name}: ") as parameter_error:
        options_from(kind, values(kind, **given))
    assert option_error.value.code == parameter_error.value.code == code
