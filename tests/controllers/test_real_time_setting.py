import pytest
import torch
from conftest import SharedEnv
from toy_controllers import StepPlanner

from lyceum_warp.controllers import RealTimeSetting, choose_setting, planning_time

SAMPLES = (16, 32, 64, 128, 256, 512, 1024)


class Machine:
    """A simulated machine. The planning time is proportional to samples times horizon."""

    def __init__(self, microseconds: float, constant: float = 1e-3, **faster: float) -> None:
        self.cost, self.constant, self.faster = 1e-6 * microseconds, constant, faster
        self.measured: list[RealTimeSetting] = []

    def __call__(self, setting: RealTimeSetting) -> float:
        self.measured.append(setting)
        cost = self.cost / self.faster.get(str(setting.physics), 1.0)
        return self.constant + cost * setting.samples * setting.horizon


@pytest.mark.parametrize("microseconds", [0.1, 0.5, 1.0, 3.0, 7.0, 20.0])
def test_largest_number_of_samples_that_meets_the_deadline_is_chosen(microseconds: float) -> None:
    machine = Machine(microseconds)
    choice = choose_setting(SAMPLES, [32], [None], machine, deadline=0.015)
    times = {number: Machine(microseconds)(RealTimeSetting(number, 32)) for number in SAMPLES}
    assert choice.setting.samples == max(number for number, seconds in times.items() if seconds <= 0.8 * 0.015)
    assert choice.planning_time == times[choice.setting.samples] and choice.replan_every == 1
    more = [number for number in SAMPLES if number > choice.setting.samples]
    assert choice.larger == ((more[0], times[more[0]]) if more else None)
    assert len(machine.measured) == len(set(machine.measured)) <= 5


def test_shorter_horizons_are_tried_before_faster_physics() -> None:
    physics = ["exact", "fast"]
    assert choose_setting(SAMPLES, [32, 16], physics, Machine(10.0, fast=10.0), deadline=0.015).setting == (
        RealTimeSetting(32, 32, "exact")
    )
    assert choose_setting(SAMPLES, [32, 16], physics, Machine(30.0, fast=10.0), deadline=0.015).setting == (
        RealTimeSetting(16, 16, "exact")
    )
    machine = Machine(120.0, fast=24.0)
    choice = choose_setting(SAMPLES, [32, 16], physics, machine, deadline=0.015)
    assert choice.setting == RealTimeSetting(64, 32, "fast")
    assert machine.measured[:2] == [RealTimeSetting(16, 32, "exact"), RealTimeSetting(16, 16, "exact")]


def test_fastest_setting_is_chosen_if_all_settings_miss_the_deadline() -> None:
    choice = choose_setting(SAMPLES, [32, 16], [None], Machine(100.0), deadline=0.01)
    # a plan takes 26.6 ms, which is 3.3 times the allowed 8 ms
    assert choice.setting == RealTimeSetting(16, 16) and choice.replan_every == 4


def test_planning_time_is_measured_on_real_plans_and_the_plant_is_restored(shared_env: SharedEnv) -> None:
    plant = shared_env("point_mass", autoreset=False)
    plant.rand_reset(5)
    before = plant.get_state()
    planner = StepPlanner(plant, seconds=0.003)
    assert planning_time(plant, planner) >= 0.003
    assert len(planner.shifts) >= 4 and torch.equal(plant.get_state(), before)
