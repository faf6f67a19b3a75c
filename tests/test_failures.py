"""Causes of failed episodes, detours, and the command on a toy run."""

from minigrid.envs.babyai.core.verifier import AfterInstr, AndInstr, GoToInstr, ObjDesc
from PIL import Image

from experiments import failures
from experiments.failures import Cause
from leapjax.domains.babyai.levels import find_level
from tests.programs import only_long, untrained_run

LEFT, FORWARD = 0, 2


def start_recorder(level: str, seed: int = 0) -> failures.Recorder:
    recorder = failures.Recorder(find_level(level))
    recorder.reset(seed)
    return recorder


def test_failures_are_classified_by_cause():
    idle = start_recorder("GoToLocalS7N5")
    assert failures.find_cause(idle) == Cause.GAVE_UP
    idle.step(LEFT)
    assert failures.find_cause(idle) == Cause.GAVE_UP
    while not idle.last.truncated:
        idle.step(LEFT)
    assert failures.find_cause(idle) == Cause.CIRCLES

    walker = start_recorder("GoToObjMazeS7")
    walker.step(FORWARD)
    assert walker.cells[0] != walker.cells[1] == tuple(walker.env.agent_pos)
    walker.cells += [(x, 0) for x in range(20)]
    walker.last = idle.last
    assert failures.find_cause(walker) == Cause.WANDERS
    walker.env.carrying = object()
    assert failures.find_cause(walker) == Cause.HOLDS


def test_detour_is_the_path_length_beyond_a_straight_path():
    recorder = start_recorder("GoToLocalS7N5")
    recorder.env.grid.horz_wall(1, 3, 4)  # open at x = 5 only
    recorder.env.agent_pos, recorder.goal = (1, 2), (1, 4)
    for x in range(1, 6):
        for y in (2, 4):
            recorder.env.grid.set(x, y, None)
    recorder.env.grid.set(5, 3, None)
    assert failures.measure_detour(recorder) == 8
    recorder.env.grid.horz_wall(1, 3, 5)
    assert failures.measure_detour(recorder) is None


@only_long
def test_command_counts_and_draws_failures(tmp_path, monkeypatch, capsys):
    run = untrained_run(tmp_path / "run", "--method", "random")
    assert failures.main([str(run), "--episodes", "6"]) == 0
    output = capsys.readouterr().out
    assert "of 6 episodes failed" in output and "what happened" in output
    assert "tasks of the instruction" not in output  # the instruction has only one
    assert Image.open(run / "failures.png").size[0] >= 336
    assert failures.main([str(run), "--episodes", "2", "--executed", "9"]) == 2
    error = capsys.readouterr().err
    assert "not in 1 .. 1" in error and str(run) in error


def test_completed_tasks_of_nested_instructions_are_listed():
    def goto():
        return GoToInstr(ObjDesc("ball"))

    both = AndInstr(goto(), goto())
    after = AfterInstr(goto(), both)
    for part in (both, after):
        part.a_done = part.b_done = False
    assert failures.list_tasks_done(goto()) == [False]
    assert failures.list_tasks_done(after) == [False, False, False]
    both.b_done = "success"
    assert failures.list_tasks_done(after) == [False, False, True]
    both.a_done, after.b_done, after.a_done = "continue", "success", "continue"
    assert failures.list_tasks_done(after) == [False, True, True]
