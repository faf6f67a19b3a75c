"""Why episodes fail: causes, detours, and the command on a toy run."""

from minigrid.envs.babyai.core.verifier import AfterInstr, AndInstr, GoToInstr, ObjDesc
from PIL import Image

from experiments import failures
from experiments.failures import Cause
from leapjax.domains.babyai.adapter import END
from leapjax.domains.babyai.bot import FullViewBot
from leapjax.domains.babyai.levels import find_level
from tests.programs import only_long, untrained_run

LEFT, FORWARD, PICKUP = 0, 2, 3


def recorder(level: str, seed: int = 0) -> failures.Recorder:
    found = failures.Recorder(find_level(level))
    found.reset(seed)
    return found


def test_causes_of_failure():
    idle = recorder("GoToLocalS7N5")
    assert failures.find_cause(idle) == Cause.GAVE_UP
    idle.step(LEFT)
    assert failures.find_cause(idle) == Cause.GAVE_UP
    while not idle.last.truncated:
        idle.step(LEFT)
    assert failures.find_cause(idle) == Cause.CIRCLES

    walker = recorder("GoToObjMazeS7")
    walker.cells += [(x, 0) for x in range(20)]
    walker.last = idle.last
    assert failures.find_cause(walker) == Cause.WANDERS
    walker.env.carrying = object()
    assert failures.find_cause(walker) == Cause.HOLDS


def test_a_detour_is_what_the_way_is_longer_than_straight():
    found = recorder("GoToLocalS7N5")
    found.env.grid.horz_wall(1, 3, 4)  # open at x = 5 only
    found.env.agent_pos, found.goal = (1, 2), (1, 4)
    for x in range(1, 6):
        for y in (2, 4):
            found.env.grid.set(x, y, None)
    found.env.grid.set(5, 3, None)
    assert failures.measure_detour(found) == 8
    found.env.grid.horz_wall(1, 3, 5)
    assert failures.measure_detour(found) is None


def test_a_recorder_knows_the_way_that_was_walked():
    found = recorder("GoToObjMazeS4", seed=3)
    bot, action = FullViewBot(found.env), None
    while found.last is None or not found.last.terminated:
        action = int(bot.replan(action))
        assert action != END
        found.step(action)
    assert len(found.cells) == found.env.step_count + 1
    assert found.cells[-1] == tuple(found.env.agent_pos)


@only_long
def test_the_command_counts_and_draws(tmp_path, monkeypatch, capsys):
    run = untrained_run(tmp_path / "run", "--method", "random")
    assert failures.main([str(run), "--episodes", "6"]) == 0
    said = capsys.readouterr().out
    assert "of 6 episodes failed" in said and "what happened" in said
    assert "tasks of the instruction" not in said  # there is one only
    assert Image.open(run / "failures.png").size[0] >= 336
    assert failures.main([str(run), "--episodes", "2", "--executed", "9"]) == 2
    error = capsys.readouterr().err
    assert "not in 1 .. 1" in error and str(run) in error


def test_tasks_that_are_done_are_counted_through_nested_instructions():
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
