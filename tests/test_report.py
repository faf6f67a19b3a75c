"""Tables and plots say what the rows say."""

from experiments import report
from leapjax.data.seeds import UNSEEN


def row(level="GoToLocalS8N7", demos=500, seed=0, successes=9, **others):
    return {
        "level": level, "method": "leap", "preset": "leapjax", "demos": demos, "seed": seed,
        "first_episode_seed": UNSEEN, "episodes": 500, "successes": 50 * successes,
        "validation": False, "train_steps": 3000, "paper_success": 95.0, "horizon": 5,
        "executed": 5, "mean_length": 6.0,
        "configuration": {"method_settings": {"masking": "random"}}, **others,
    }  # fmt: skip


ROWS = [
    row(), row(seed=1, successes=10), row(demos=50, successes=5), row(demos=50, successes=7),
    row(demos=100, validation=True), row(demos=100, preset="paper"), row("PickUpLoc", successes=3),
    # Other levels than all others are measured on, and a checkpoint played again.
    row(first_episode_seed=0, successes=0), row(episodes=600), row(train_steps=0, successes=0),
]  # fmt: skip


def test_a_later_row_of_a_seed_counts_and_fewer_demonstrations_are_not_the_papers():
    found = cells(report.success(ROWS), "S8N7")
    assert found[:5] == ["GoToLocalS8N7", "95.0%", "-", "-", "-"]
    assert found[5].startswith("95.0% [") and found[5].endswith("2 seeds")


def test_fresh_levels_go_before_those_of_development():
    earlier = [
        {**row(seed=seed), "first_episode_seed": 0, "episodes": 200, "successes": 100}
        for seed in (0, 1, 2)
    ]
    (cell,) = cells(report.success(earlier), "S8N7")[5:6]
    assert cell.startswith("50.0% [") and cell.endswith(", 3 seeds \\*")
    (cell,) = cells(report.success([*earlier, row()]), "S8N7")[5:6]
    assert cell.startswith("90.0% [") and cell.endswith(", 1 seed")


def cells(table, level):
    (line,) = (line for line in table.splitlines() if level in line)
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_settings_are_kept_apart():
    earlier = {"first_episode_seed": 0, "episodes": 200}  # what these were played on
    paper = [
        {**row(preset="paper", configuration={"method_settings": {"masking": masking}}), **found}
        for masking, rate in (("one", 0.7), ("each", 0.8), ("random", 0))
        for found in [{**earlier, "successes": int(200 * rate)}]
    ]
    nothing = {"configuration": {"method_settings": {}}}
    others = [
        row(method="random", demos=0, train_steps=0, successes=1, **nothing),
        row(method="classifier", successes=0, **nothing),
    ]
    sooner = [row(executed=3, successes=10, mean_length=4.0), row(executed=1, successes=0)]
    found = cells(report.success([*ROWS, *paper, *others, *sooner]), "S8N7")
    rates = ["95.0", "10.0", "70.0", "80.0", "95.0", "100.0"]
    assert [cell.split("%")[0] for cell in found[1:]] == rates
    found = cells(report.steps([*ROWS, *sooner]), "S8N7")
    assert found[1:] == ["-", "-", "-", "6.0", "4.0"]
