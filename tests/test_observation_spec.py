"""What an agent is shown: the combinations that are refused, and configurations with sensors."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from tdanet_jax import config as configs
from tdanet_jax.config import NetworkConfig, TrainConfig
from tdanet_jax.observation_spec import ObservationSpec
from tests.support import step_counter

BOTH = ("odometry", "triangulation")


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        (
            ObservationSpec(sensors=("odometry", "sonar")),
            "--sensors sonar: choose among odometry, triangulation, robust-triangulation, or name "
            "a module",
        ),
        (
            ObservationSpec(sensors=("triangulation",)),
            "--triangulation: needs --odometry (or use --no-triangulation)",
        ),
        (
            ObservationSpec(sensors=("triangulation", "odometry")),
            "--triangulation: needs --odometry (or use --no-triangulation)",
        ),
        (
            ObservationSpec(sensors=("robust-triangulation",)),
            "--robust-triangulation: needs --odometry (or leave it out)",
        ),
        (
            ObservationSpec(sensors=(*BOTH, "robust-triangulation")),
            "--triangulation: not with robust-triangulation, too",
        ),
        (
            ObservationSpec(rows="class", sensors=("odometry", "robust-triangulation")),
            "--robust-triangulation: needs a box of every object, which --rows class does not "
            "show; leave it out",
        ),
        (
            ObservationSpec(rows="class", sensors=BOTH),
            "--triangulation: needs a box of every object, which --rows class does not show; "
            "use --no-triangulation",
        ),
        (
            ObservationSpec(image="features", sensors=BOTH),
            "--triangulation: needs a box of every object, which --image features does not show; "
            "use --no-triangulation",
        ),
        (
            ObservationSpec(rows="class", scores=True),
            "--scores: needs a box of every object, which --rows class does not show; "
            "use --no-scores",
        ),
    ],
)
def test_a_combination_that_does_not_go_together_is_refused_in_one_line(
    spec: ObservationSpec, message: str
) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        spec.check()


@pytest.mark.parametrize(
    "spec", [ObservationSpec("class", None, BOTH), ObservationSpec("object", "raster", BOTH)]
)
def test_the_message_names_the_model_that_decides(spec: ObservationSpec) -> None:
    with pytest.raises(ValueError, match=r"every object, which my_lab\.most_alike does not show"):
        spec.check("my_lab.most_alike")


@pytest.mark.parametrize("rows", ["object", "class"])
@pytest.mark.parametrize("image", [None, "raster", "features"])
@pytest.mark.parametrize("sensors", [(), ("odometry",), ("my_lab.compass",)])
def test_everything_else_goes_together(rows: Any, image: Any, sensors: tuple[str, ...]) -> None:
    ObservationSpec(rows, image, sensors).check()
    ObservationSpec(sensors=(*BOTH, *sensors)).check()


@pytest.mark.parametrize(
    ("network", "sensors"),
    [
        (NetworkConfig(), ()),
        (NetworkConfig(odometry=True), ("odometry",)),
        (NetworkConfig(odometry=True, triangulation=True), BOTH),
        (NetworkConfig(odometry=True, sensors=("my_lab.compass",)), ("odometry", "my_lab.compass")),
        (NetworkConfig(sensors=("my_lab.compass", *BOTH)), ("my_lab.compass", *BOTH)),
        (NetworkConfig(odometry=True, sensors=("odometry", "a.b", "a.b")), ("odometry", "a.b")),
    ],
)
def test_flags_say_what_is_sensed_and_in_which_order(
    network: NetworkConfig, sensors: tuple[str, ...]
) -> None:
    assert network.spec == ObservationSpec(sensors=sensors)
    TrainConfig(network=network).check()
    assert NetworkConfig(rows="class").spec.rows == "class"


@pytest.mark.parametrize(
    ("sensors", "flag"), [(("sonar",), "--sensors sonar"), (("triangulation",), "--triangulation")]
)
def test_a_configuration_is_refused_for_its_sensors(sensors: tuple[str, ...], flag: str) -> None:
    with pytest.raises(ValueError, match=f"^{flag}: "):
        TrainConfig(network=NetworkConfig(sensors=sensors)).check()
    with pytest.raises(ValueError, match=r"^--sensors .*must be a tuple of strings"):
        TrainConfig(network=NetworkConfig(sensors=list(sensors))).check()  # type: ignore[arg-type]


def saved(tmp_path: Path, *sensors: str) -> tuple[Path, TrainConfig]:
    config = TrainConfig(network=NetworkConfig(odometry=True, sensors=sensors))
    configs.save(config, tmp_path / "config.json")
    return tmp_path / "config.json", config


def test_a_configuration_with_sensors_is_read_as_it_was_written(tmp_path: Path) -> None:
    path, config = saved(tmp_path, "odometry", step_counter.NAME)  # imported here already
    assert configs.load(path) == config
    assert configs.from_json(json.loads(json.dumps(configs.to_json(config)))) == config


def test_the_configuration_of_a_run_from_before_sensors_has_none(tmp_path: Path) -> None:
    path, config = saved(tmp_path)
    values = json.loads(path.read_text())
    del values["network"]["sensors"]
    path.write_text(json.dumps(values))
    assert configs.load(path) == config


def test_a_run_with_a_custom_sensor_is_read_only_by_those_who_trust_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path, config = saved(tmp_path, "some_lab.sonar", "some_lab.compass")
    refused = r"its sensor is custom code, some_lab\.sonar; .* set TDANET_TRUST=some_lab\.sonar"
    with pytest.raises(ValueError, match=refused) as caught:
        configs.load(path)
    assert str(path) in str(caught.value)
    monkeypatch.setenv(configs.TRUST, "some_lab,another_lab.sonar")
    with pytest.raises(ValueError, match=refused):
        configs.load(path)
    # Each of them must be trusted.
    monkeypatch.setenv(configs.TRUST, "some_lab.sonar")
    with pytest.raises(ValueError, match=r"set TDANET_TRUST=some_lab\.compass"):
        configs.load(path)
    monkeypatch.setenv(configs.TRUST, "some_lab.sonar,some_lab.compass")
    assert configs.load(path) == config
    monkeypatch.delenv(configs.TRUST)
    for name in config.network.sensors:
        monkeypatch.setitem(sys.modules, name, sys)
    assert configs.load(path) == config
