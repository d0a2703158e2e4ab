"""Plans: shipped ones are valid; errors name the entry and suggest the closest known name."""

import re

import pytest
import yaml
from hypothesis import example, given, settings
from hypothesis import strategies as st

from symbid_ros.choices import METHODS
from symbid_ros.errors import StudyError, SymbidError
from symbid_ros.package_paths import config_file
from symbid_ros.study.plan import Plan, PriorSpread, SimulatedLog, load_plan, shipped_studies

NAMES = ("thesis", "excitation", "sensors", "noise", "length", "errors")


def test_shipped_studies_are_known_by_name():
    assert {file.stem for file in shipped_studies()} == {f"study_{name}" for name in NAMES}
    for name in NAMES:
        plan, path = load_plan(name)
        assert path == config_file(f"study_{name}.yaml")
        assert plan.thesis == (name == "thesis")


def test_thesis_study_has_the_thesis_settings_and_our_methods():
    plan, _ = load_plan("thesis")
    assert [str(spread) for spread in plan.priors] == ["±12.5 %", "±25 %", "±50 %", "±0.125"]
    assert plan.filters == [0, 30, 50, 70, 100]
    assert plan.iterations == 20
    assert set(plan.methods) == set(METHODS)
    assert {log.scenario for log in plan.data.values()} == {"smooth", "vibrating"}


def changed(text: str, old: str, new: str) -> str:
    assert old in text
    return text.replace(old, new, 1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("iterations: 20", "iteratons: 20", "unknown key iteratons (did you mean 'iterations'?)"),
        (
            "scenario: smooth,",
            "scenarios: smooth,",
            "scenarios (did you mean 'scenario'?)",
        ),
        ("- { percent: 12.5 }", "- { percnt: 12.5 }", "priors.0.percnt (did you mean 'percent'?)"),
        ("by: gen_force", "bye: gen_force", "z.bye (did you mean 'by'?)"),
        ("com: 70.0", "con: 70.0", "figures.con (did you mean 'com'?)"),
        ("  moves: 4\n", "  move: 4\n", "closed_loop.move (did you mean 'moves'?)"),
        ("moves: 20,", "moves: 0,", "data.smooth.moves"),
        ("scenario: smooth,", "scenario: walk,", "data.smooth.scenario"),
        ("- { percent: 12.5 }", "- { percent: 12.5, absolute: 1.0 }", "one of percent, absolute"),
        ("- { percent: 12.5 }", "- { percent: -12.5 }", "priors.0.percent"),
        ("- { percent: 12.5 }", "- { percent: .nan }", "priors.0.percent"),
        ("- { percent: 12.5 }", "- { percent: 25.0 }", "priors repeat"),
        ("com: 70.0", "com: 71.0", "71 Hz is missing from filters"),
        ("[0.0, 30.0", "[0.0, 0.0", "filters repeat"),
        ("  data: smooth\n  prior:", "  data: smoth\n  prior:", "(did you mean 'smooth'?)"),
        ("wls_rc, map, map_lmi]", "wls_r, map, map_lmi]", "methods repeat"),
        ("wls_rc, map, map_lmi]", "map, map_lmi]", "figures show wls_rc"),
        ("noise_seed: 11", "noise_seed: true", "data.smooth.noise_seed"),
        ("  smooth:", "  ../smooth:", "data.../smooth"),
        ("  iterations: 5", "  iterations: 50", "closed_loop.iterations is more"),
        ("21, noise: 0.0", "21, noise: 0.1", "validation: must be an ideal log"),
        ("31, noise: 0.0", "31", "equation: must be an ideal log"),
        ("title:", "title: [", "not valid YAML"),
    ],
)
def test_invalid_entry_is_named_in_one_line(tmp_path, old, new, message):
    file = tmp_path / "mine.yaml"
    text = config_file("study_thesis.yaml").read_text(encoding="utf-8")
    file.write_text(changed(text, old, new), encoding="utf-8")
    with pytest.raises(StudyError, match=re.escape(message)) as caught:
        load_plan(str(file))
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)
    assert "Value error" not in str(caught.value)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("thesi", "did you mean 'thesis'"),
        ("walking", "choose one of errors, excitation"),
        ("missing.yaml", "cannot be read"),
    ],
)
def test_unknown_study_is_rejected(name, message):
    with pytest.raises(StudyError, match=message):
        load_plan(name)


def test_cure_needs_all_sensors():
    content = {"title": "A", "priors": [{"percent": 25.0}]}
    with pytest.raises(ValueError, match="cure needs all sensors"):
        Plan.model_validate(content | {"data": {"a": {"cure": True, "sensors": "base_rows"}}})


@pytest.mark.parametrize(
    ("spread", "text"), [({"percent": 12.5}, "±12.5 %"), ({"absolute": 0.125}, "±0.125")]
)
def test_label_of_a_prior_spread(spread, text):
    assert str(PriorSpread(**spread)) == text


SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
VALUES = SCALARS | st.lists(SCALARS | st.lists(SCALARS, max_size=2), max_size=3)
VALUES |= st.dictionaries(st.text(max_size=8), VALUES, max_size=3)


@given(
    place=st.sampled_from(sorted(Plan.model_fields)),
    value=VALUES,
    nested=st.sampled_from(["", "smooth", "prior", "logs"]),
)
@example(place="accelerations", value={"\n": None}, nested="")
@settings(max_examples=150, deadline=None)
def test_any_entry_gives_a_plan_or_a_one_line_error(tmp_path_factory, place, value, nested):
    content = yaml.safe_load(config_file("study_thesis.yaml").read_text(encoding="utf-8"))
    if nested and isinstance(content.get(place), dict):
        content[place][nested] = value
    else:
        content[place] = value
    file = tmp_path_factory.mktemp("plans") / "any.yaml"
    file.write_text(yaml.safe_dump(content, allow_unicode=True), encoding="utf-8")
    message = ""
    try:
        load_plan(str(file))
    except SymbidError as error:
        message = str(error)
    assert "\n" not in message


def test_validation_logs_have_the_friction_of_the_data():
    content = {"title": "A", "priors": [{"percent": 25.0}]}
    plan = Plan.model_validate(content | {"data": {"smooth": {}, "friction": {"friction": True}}})
    for name, friction in (("smooth", False), ("friction", True)):
        ideal, noisy = plan.validation_log(name), plan.noisy_validation_log(name)
        assert (ideal.friction, ideal.noise) == (friction, 0.0)
        assert (noisy.friction, noisy.noise) == (friction, 1.0)
        assert noisy.motion_seed == ideal.motion_seed


def test_a_log_is_described_with_the_name_of_each_seed():
    log = SimulatedLog(moves=2, motion_seed=11, noise_seed=12, noise=0.1)
    assert log.description == "smooth, 2 moves, motion seed 11, noise x 0.1, noise seed 12"
    assert SimulatedLog(moves=1).description.startswith("smooth, 1 move, motion seed 1")
    assert SimulatedLog(noise=0.0).description == "smooth, 20 moves, motion seed 1, no noise"
