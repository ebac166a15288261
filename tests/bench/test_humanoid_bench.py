import experiment
import humanoid


def test_each_humanoid_task_has_its_own_success_criterion() -> None:
    def row(task: str, **result: object) -> experiment.Row:
        usual = {"fell": False, "speed": 0.7, "up_at_the_end": True, "seconds": 20.0, "plans": 100, "misses": 1,
                 "plan_ms": 8.0, "plan_max_ms": 16.0, "oldest_action_steps": 2}  # fmt: skip
        return experiment.Row(
            {"task": task, "contestant": "real_time", "settings": "knots 8", "threads": 2}, usual | result, {}, 1.0
        )

    rows = [
        row("humanoid_stand", speed=0.0), row("humanoid_stand", fell=True), row("humanoid_walk", speed=0.4),
        row("humanoid_walk", fell=True), row("humanoid_walk"), row("humanoid_get_up", up_at_the_end=False),
    ]  # fmt: skip
    (table,) = humanoid.tables(rows)
    assert [line[4].partition(" (")[0] for line in table.rows] == ["1 of 2", "1 of 3", "0 of 1"]
    assert {line[7] for line in table.rows} == {"99.00%"}
