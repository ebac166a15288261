import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from hidden_robots import ARM, HOPPING, NOISE, STIFF, log_of

import lyceum_warp as lw
from lyceum_warp.fitting import Fit
from lyceum_warp.fitting.windows import Predictor, Windows

TRUTH = {
    "kp.shoulder": 0.2, "kp.elbow": -0.2, "kd.*": 0.15, "dof_armature.*": 0.25, "body_mass.lower": -0.25,
    "body_ipos.lower[2]": 0.02, "delay.ctrl.*": 0.012,
}  # fmt: skip
PARAMETERS = list(TRUTH)


def controls(seconds: float, seed: int = 0) -> np.ndarray:
    kinds = [lw.excitation([-0.8] * 2, [0.8] * 2, kind, seconds=seconds / 2, rate=100, seed=seed, frequencies=(0.3, 4))
             for kind in ("chirp", "steps")]  # fmt: skip
    return np.concatenate(kinds)


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> tuple[Fit, dict[str, Any], Path]:
    log = log_of(ARM, PARAMETERS, TRUTH, controls(5.0))
    folder = tmp_path_factory.mktemp("fit")
    fit = lw.fit(mujoco.MjSpec.from_string(ARM), log, PARAMETERS, out=folder, samples=8, nthread=1)
    return fit, log, folder


def coordinates(fit: Fit, values: np.ndarray) -> dict[str, float]:
    return {
        name: float(np.log(value) if kind == "factor" else value)
        for name, kind, value in zip(fit.names, fit.kinds, values, strict=True)
    }


def test_fit_recovers_a_hidden_arm(arm: tuple[Fit, dict[str, Any], Path]) -> None:
    fit, _, _ = arm
    for name, x in coordinates(fit, fit.value).items():
        assert abs(x - TRUTH[name]) < (0.001 if name.startswith("delay") else 0.02), name
    low, high = coordinates(fit, fit.low), coordinates(fit, fit.high)
    covered = [low[name] <= TRUTH[name] <= high[name] for name in fit.names]
    assert sum(covered) >= len(covered) - 1  # 95 % intervals
    assert fit.determined.all() and not fit.directions
    assert fit.noise["qpos"] == pytest.approx(0.002, rel=0.1) and fit.noise["qvel"] == pytest.approx(0.05, rel=0.1)
    assert fit.held_out[1] < 1.1 < 3.0 < fit.held_out[0]


def test_intervals_narrow_with_the_noise(arm: tuple[Fit, dict[str, Any], Path]) -> None:
    log = log_of(ARM, PARAMETERS, TRUTH, controls(5.0), noise=0.05)
    exact = lw.fit(mujoco.MjSpec.from_string(ARM), log, PARAMETERS, samples=8, nthread=1)
    assert exact.determined.all()
    assert ((exact.high - exact.low) < 0.2 * (arm[0].high - arm[0].low)).all()


def test_fit_writes_a_folder_with_a_page(arm: tuple[Fit, dict[str, Any], Path]) -> None:
    fit, _, folder = arm
    content = json.loads((folder / "fit.json").read_text())
    assert content["names"] == PARAMETERS and content["delays"].keys() == {"shoulder", "elbow"}
    page = (folder / "report.html").read_text()
    assert "kp.shoulder" in page and page.count("data:image/png") == 2
    assert all(name in fit.text for name in (*PARAMETERS, "in multiples of the noise"))


def test_finished_fit_resumes_without_further_steps(arm: tuple[Fit, dict[str, Any], Path]) -> None:
    fit, log, folder = arm
    stages: list[str] = []
    again = lw.fit(
        mujoco.MjSpec.from_string(ARM), log, PARAMETERS, out=folder, resume=True, iterations=1, nthread=1,
        progress=lambda stage, k, cost: stages.append(stage),
    )  # fmt: skip
    assert not stages and np.array_equal(again.value, fit.value)
    with pytest.raises(ValueError, match="belongs to another log, model or parameters"):
        lw.fit(mujoco.MjSpec.from_string(ARM), log, PARAMETERS[1:], out=folder, resume=True, samples=0, nthread=1)


def test_stopped_fit_resumes_on_its_part_of_the_log(tmp_path: Path) -> None:
    log = log_of(ARM, ["kp.*"], {"kp.*": 0.2}, controls(10.0))
    settings: dict[str, Any] = {"samples": 0, "window": 0.1, "nthread": 1}
    whole = lw.fit(mujoco.MjSpec.from_string(ARM), log, ["kp.*"], **settings)
    lw.fit(mujoco.MjSpec.from_string(ARM), log, ["kp.*"], out=tmp_path, iterations=1, **settings)
    with np.load(tmp_path / "estimate.npz") as file:
        assert len(file["states"]) == 20  # two blocks of ten windows
    again = lw.fit(mujoco.MjSpec.from_string(ARM), log, ["kp.*"], out=tmp_path, resume=True, **settings)
    assert np.array_equal(again.value, whole.value) and np.array_equal(again.low, whole.low)


def test_parameters_that_a_log_cannot_tell_apart_are_named() -> None:
    # below the servo's limit, its kd and the joint's damping both multiply the velocity
    log = log_of(ARM, ["kd.shoulder"], {}, lw.excitation([-0.2] * 2, [0.2] * 2, seconds=4.0, rate=100))
    names = ["kd.shoulder", "dof_damping.shoulder"]
    fit = lw.fit(mujoco.MjSpec.from_string(ARM), log, names, samples=0, nthread=1, iterations=6)
    assert [set(direction) for direction in fit.directions] == [set(names)]


def test_held_out_error_tells_a_delayed_servo_from_an_ideal_one() -> None:
    spec, delayed = (
        mujoco.MjSpec.from_string(ARM),
        log_of(ARM, ["delay.ctrl.*"], {"delay.ctrl.*": 0.013}, controls(3.0)),
    )
    without, with_delay = (
        lw.fit(spec, delayed, names, samples=0, nthread=1, iterations=6)
        for names in (["kp.*", "kd.*"], ["kp.*", "kd.*", "delay.ctrl.*"])
    )
    assert with_delay.errors["qpos"][1] < 0.0022 and without.errors["qpos"][1] > 1.3 * with_delay.errors["qpos"][1]
    assert with_delay.delays["elbow"] == pytest.approx(0.013, abs=5e-4)
    ideal = lw.fit(spec, log_of(ARM, ["kp.*"], {}, controls(3.0)), ["kp.*", "delay.ctrl.*"], samples=0, nthread=1)
    assert ideal.low[1] == 0.0 and ideal.high[1] < 1e-3


@pytest.mark.parametrize("delay", [0.0093, 0.0097])
def test_delay_of_a_stiff_joint_is_found_beside_a_whole_number_of_substeps(delay: float) -> None:
    # nearly all information is in the samples right after a step of the controls
    truth = {"kp.*": 0.1, "kd.*": -0.1, "delay.ctrl.*": delay}
    control = np.repeat(lw.excitation([-0.4], [0.4], "steps", seconds=6.0, rate=50, frequencies=(0.3, 4)), 4, axis=0)
    log = log_of(STIFF, list(truth), truth, control, dt=0.005, substeps=1)
    fit = lw.fit(mujoco.MjSpec.from_string(STIFF), log, list(truth), samples=0, nthread=1)
    for name, x in coordinates(fit, fit.value).items():
        assert abs(x - truth[name]) < (1e-4 if name.startswith("delay") else 0.02), name
    assert fit.high[2] - fit.low[2] < 2e-4


def test_windows_with_contacts_determine_mass_and_gain() -> None:
    names = ["kp.leg", "body_mass.body"]
    truth = {"kp.leg": 0.2, "body_mass.body": -0.2}
    control = lw.excitation([-0.05], [0.08], "walk", seconds=4.0, rate=100, frequencies=(0.1, 8.0))
    log = log_of(HOPPING, names, truth, control, noise=0.3)
    fit = lw.fit(mujoco.MjSpec.from_string(HOPPING), log, names, samples=0, nthread=1, window=0.1, iterations=10)
    for name, x in coordinates(fit, fit.value).items():
        assert abs(x - truth[name]) < 0.03, name
    low, high = coordinates(fit, fit.low), coordinates(fit, fit.high)
    assert all(low[name] <= truth[name] <= high[name] for name in names)


def test_small_jumps_of_predictions_neither_stop_a_fit_nor_narrow_its_intervals(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    smooth = Predictor.predict

    def jumping(self: Predictor, windows: Windows, states: np.ndarray, xs: np.ndarray, *more: Any) -> Any:
        # a number that grows with the parameters and falls by 0.2 times the noise, as the time from a foot's contact
        # to the end of its substep: few of the finite differences meet a fall
        phase = 20.0 * xs.sum(axis=1)[:, None, None] + 1e4 * windows.measured[:, None]
        late = 0.2 * np.repeat([NOISE["qpos"], NOISE["qvel"]], 2) * (phase % 1.0 - 0.5)
        rows, ends = smooth(self, windows, states, xs, *more)
        return rows + late, ends

    truth = {"kp.*": 0.2, "dof_damping.*": -0.2, "body_mass.lower": 0.2}
    log = log_of(ARM, list(truth), truth, controls(4.0))
    widths = []
    for predict in (smooth, jumping):
        monkeypatch.setattr(Predictor, "predict", predict)
        fit = lw.fit(mujoco.MjSpec.from_string(ARM), log, list(truth), samples=0, nthread=1)
        for name, x in coordinates(fit, fit.value).items():
            assert abs(x - truth[name]) < 0.02, name
        widths.append(np.log(fit.high / fit.low))
    assert (widths[1] > 0.5 * widths[0]).all()


def test_default_fit_of_a_free_base_writes_a_folder(tmp_path: Path) -> None:
    control = lw.excitation([-0.05], [0.08], "walk", seconds=2.0, rate=100, frequencies=(0.1, 8.0))
    log = log_of(HOPPING, ["kp.leg"], {}, control)
    fit = lw.fit(mujoco.MjSpec.from_string(HOPPING), log, samples=0, nthread=1, iterations=1, out=tmp_path)
    assert "dof_frictionloss.*" in fit.names
    assert fit.fields["dof_frictionloss"].keys() == {"leg"}  # the base has no friction
    assert (tmp_path / "draws.npz").is_file()


def test_outliers_hardly_move_a_fit() -> None:
    log = log_of(ARM, ["kp.*"], {"kp.*": 0.2}, controls(3.0))
    rng = np.random.default_rng(0)
    spikes = rng.random(log["qpos"].shape) < 0.01
    log["qpos"] = log["qpos"] + spikes * rng.choice([-0.5, 0.5], spikes.shape)
    fit = lw.fit(mujoco.MjSpec.from_string(ARM), log, ["kp.*"], samples=0, nthread=1)
    assert np.log(fit.value[0]) == pytest.approx(0.2, abs=0.01)


def test_bias_and_lateness_of_sensors_with_missing_samples_are_fitted() -> None:
    log = log_of(ARM, ["kp.*"], {"kp.*": 0.1}, controls(4.0))
    (shoulder, elbow), time = log.pop("qpos").T, log["time"]
    elbow[np.random.default_rng(1).random(len(elbow)) < 0.2] = np.nan
    late = np.stack([np.interp(time - 0.008, time, column) for column in log["qvel"].T], axis=1)
    late[::2] = np.nan  # a sensor of half the rate
    log |= {"qpos.shoulder": shoulder + 0.03, "qpos.elbow": elbow, "qvel": late}
    names = ["kp.*", "bias.qpos.shoulder", lw.Parameter(name="delay.qvel*", high=0.02)]
    fit = lw.fit(mujoco.MjSpec.from_string(ARM), log, names, samples=0, nthread=1)
    assert np.log(fit.value[0]) == pytest.approx(0.1, abs=0.01)
    assert fit.value[1] == pytest.approx(0.03, abs=0.002)
    assert fit.value[2] == pytest.approx(0.008, abs=0.001)


def test_robot_that_hangs_is_fitted_without_its_base() -> None:
    spec = mujoco.MjSpec.from_string(HOPPING)
    spec.delete(spec.joint("base"))
    spec.delete(spec.geom("floor"))
    control = lw.excitation([-0.08], [0.08], "walk", seconds=3.0, rate=100, frequencies=(0.1, 8.0))
    log = log_of(spec.to_xml(), ["kp.leg"], {"kp.leg": 0.3}, control, noise=0.3)
    hopping = mujoco.MjSpec.from_string(HOPPING)
    fit = lw.fit(hopping, log, ["kp.leg", "dof_damping.leg"], hangs=True, samples=0, nthread=1)
    assert np.log(fit.value[0]) == pytest.approx(0.3, abs=0.02)
    assert fit.value[1] == pytest.approx(1.0, abs=0.1)


def test_base_without_a_measured_position_starts_from_the_imu() -> None:
    names, truth = ["kp.leg", "body_mass.body"], {"kp.leg": 0.2, "body_mass.body": -0.2}
    control = lw.excitation([-0.05], [0.08], "walk", seconds=4.0, rate=100, frequencies=(0.1, 8.0))
    whole = log_of(HOPPING, names, truth, control, noise=0.3)
    log = {"time": whole["time"], "ctrl": control, "qpos.leg": whole["qpos"][:, 7], "qvel.leg": whole["qvel"][:, 6]}
    log |= {f"qpos.base[{k}]": whole["qpos"][:, k] for k in (3, 4, 5, 6)}  # the orientation
    log |= {f"qvel.base[{k}]": whole["qvel"][:, k] for k in (3, 4, 5)}  # the gyro
    fit = lw.fit(mujoco.MjSpec.from_string(HOPPING), log, names, samples=0, nthread=1, window=0.1, iterations=10)
    for name, x in coordinates(fit, fit.value).items():
        assert abs(x - truth[name]) < 0.05, name
