"""Where measurements go, and what is kept of every episode."""

import csv
import struct
import sys
from types import SimpleNamespace

import pytest

from leapjax import domains
from leapjax.errors import UserError
from leapjax.running import command_line, loggers, results
from leapjax.running import main as running
from tests.frozen_lake import FROZEN_LAKE
from tests.programs import LAKE, SMALL, only_long

TRAINED = [*SMALL, "--demos", "3", "--steps", "4"]


def read(folder):
    """What TensorBoard's files hold: [(name, step, value)], and the steps of their starts."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    events = []
    for path in sorted(folder.iterdir()):
        data, place = path.read_bytes(), 0
        while place < len(data):  # length, its checksum, record, its checksum
            (length,) = struct.unpack("<Q", data[place : place + 8])
            events.append(event_pb2.Event.FromString(data[place + 12 : place + 12 + length]))
            place += length + 16
    values = [(v.tag, event.step, v.simple_value) for event in events for v in event.summary.value]
    return values, [event.step for event in events if event.HasField("session_log")]


@pytest.fixture
def workplace(tmp_path, monkeypatch, quick_begin):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(domains.DOMAINS, LAKE.domain, FROZEN_LAKE)
    return tmp_path


@pytest.fixture
def sent(monkeypatch):
    """What Weights & Biases was given, in its place."""
    heard = SimpleNamespace(begun=[], logged=[], finished=[])

    def init(**options):
        heard.begun.append(options)
        return SimpleNamespace(
            log=lambda values, step: heard.logged.append((step, values)),
            finish=lambda: heard.finished.append(True),
        )

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    return heard


@only_long
def test_training_and_evaluation_go_to_every_logger(workplace, sent, monkeypatch):
    monkeypatch.delenv("WANDB_MODE", raising=False)
    arguments = [*TRAINED, "--loggers", "tensorboard", "wandb", "--record"]
    assert running.main(LAKE, arguments) == 0
    (row,) = results.read(workplace / "results" / "lake.jsonl")
    (folder,) = (path for path in (workplace / "runs").iterdir() if path.is_dir())
    ((_, values), (last, measured)) = sent.logged
    assert last == 4 and measured["evaluation/success"] == row["successes"] / row["episodes"]
    (metrics,) = csv.DictReader((folder / "metrics.csv").read_text().splitlines())
    assert values["training/loss"] == pytest.approx(float(metrics["loss"]))
    (begun,) = sent.begun
    assert begun["mode"] == "offline" and begun["id"] == row["hash"] and sent.finished == [True]
    assert begun["config"]["training"]["steps"] == 4
    everything = {**values, **measured}
    found, _ = read(folder / "tensorboard")
    assert {name: value for name, step, value in found if step == 4} == pytest.approx(everything)
    (played,) = results.read_episodes(workplace / "results" / "lake.jsonl").values()
    assert played["seed"].tolist() == [10_000_000 + i for i in range(3)]
    assert played["success"].sum() == row["successes"]
    assert played["return"].mean() == pytest.approx(row["mean_return"])
    assert played["length"].mean() == pytest.approx(row["mean_length"])


def test_a_run_that_goes_on_says_where_it_began(tmp_path, sent, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "online")  # asked for
    about = loggers.About(tmp_path, "abc", {}, 40)
    with loggers.open_loggers(["wandb", "tensorboard"], lambda: about) as log:
        assert not sent.begun  # with the first value, and not before
        log(60, {"training/loss": 0.5})
    assert sent.begun[0]["mode"] == "online" and sent.begun[0]["resume"] == "allow"
    # TensorBoard drops what earlier files have from there on: step 40 was logged, and is not again.
    assert read(tmp_path / "tensorboard") == ([("training/loss", 60, 0.5)], [41])


def test_loggers_that_there_are_not_are_one_line(monkeypatch):
    with pytest.raises(UserError, match="unknown logger 'csv': expected some of tensorboard"):
        command_line.parse("babyai", ["--loggers", "csv"])
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(UserError, match=r'pip install "\.\[tensorboard\]"'):
        command_line.parse("babyai", ["--loggers", "tensorboard"])
