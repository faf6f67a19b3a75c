"""Tables and plots say what the rows say."""

from PIL import Image

from experiments import report
from experiments.common import plots


def row(level="GoToLocalS8N7", demos=500, seed=0, successes=9, **others):
    return {
        "level": level, "method": "leap", "preset": "leapjax", "demos": demos, "seed": seed,
        "first_episode_seed": 0, "episodes": 200, "successes": 20 * successes,
        "validation": False, "train_steps": 3000, "paper_success": 95.0, "horizon": 5,
        "executed": 5, "mean_length": 6.0,
        "configuration": {"method_settings": {"masking": "random"}}, **others,
    }  # fmt: skip


ROWS = [
    row(), row(seed=1, successes=10), row(demos=50, successes=5), row(demos=50, successes=7),
    row(demos=100, validation=True), row(demos=100, preset="paper"), row("PickUpLoc", successes=3),
    # Other levels than all others are measured on, and a checkpoint played again.
    row(first_episode_seed=1000, successes=0), row(episodes=400), row(train_steps=0, successes=0),
]  # fmt: skip


def test_a_later_row_of_a_seed_counts_and_fewer_demonstrations_are_not_the_papers():
    found = cells(report.success(ROWS), "S8N7")
    assert found[:5] == ["GoToLocalS8N7", "95.0%", "-", "-", "-"]
    assert found[5].startswith("95.0% [") and found[5].endswith("2 seeds")


def cells(table, level):
    (line,) = (line for line in table.splitlines() if level in line)
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_settings_are_kept_apart():
    paper = [
        row(preset="paper", successes=s, configuration={"method_settings": {"masking": masking}})
        for masking, s in (("one", 7), ("each", 8), ("random", 0))
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


def test_fewer_demonstrations_are_side_by_side():
    lines = report.efficiency(ROWS).splitlines()
    assert lines[0] == "| level | 50 demonstrations | 500 demonstrations | paper, 500 |"
    assert len(lines) == 3  # PickUpLoc has only one number of demonstrations
    cells = [cell.strip() for cell in lines[2].strip("|").split("|")]
    assert cells[0] == "GoToLocalS8N7" and cells[1].startswith("70.0% [")
    assert cells[2].startswith("95.0% [") and cells[3] == "95.0%"


def test_data_efficiency_is_drawn(tmp_path):
    path = tmp_path / "plot.png"
    plots.data_efficiency(report.efficiency_by_level(ROWS), path)
    assert Image.open(path).size[0] > 500


def test_scaling_is_relative_to_two_devices_of_one_process():
    measured = [
        {"processes": p, "devices": d, "fsdp": 1, "seconds_per_step": 0.01,
         "examples_per_second": e, "exchange_seconds": 0.001}
        for p, d, e in ((1, 1, 600.0), (1, 2, 1000.0), (2, 2, 800.0))
    ]  # fmt: skip
    lines = report.scaling(measured).splitlines()[2:]
    assert [line.split("|")[6].strip() for line in lines] == ["60%", "100%", "80%"]
