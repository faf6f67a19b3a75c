"""Loggers receive the measurements of a run, and every episode is recorded."""

import csv
import struct
import sys
from types import SimpleNamespace

import pytest

from leapjax import domains
from leapjax.errors import UserError
from leapjax.running import command_line, loggers, metrics, results
from leapjax.running import main as running
from tests.frozen_lake import FROZEN_LAKE
from tests.programs import LAKE, SMALL, only_long

TRAINED = [*SMALL, "--demos", "3", "--steps", "4"]


def read(folder):
    """Reads TensorBoard's files: [(name, step, value)], and the first step of each session."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    events = []
    for path in sorted(folder.iterdir()):
        data, offset = path.read_bytes(), 0
        while offset < len(data):  # length, its checksum, record, its checksum
            (length,) = struct.unpack("<Q", data[offset : offset + 8])
            events.append(event_pb2.Event.FromString(data[offset + 12 : offset + 12 + length]))
            offset += length + 16
    values = [(v.tag, event.step, v.simple_value) for event in events for v in event.summary.value]
    return values, [event.step for event in events if event.HasField("session_log")]


@pytest.fixture
def workplace(tmp_path, monkeypatch, quick_begin):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(domains.DOMAINS, LAKE.domain, FROZEN_LAKE)
    return tmp_path


@pytest.fixture
def wandb(monkeypatch):
    """Replaces Weights & Biases by a stub; returns the calls that it received."""
    calls = SimpleNamespace(begun=[], logged=[], finished=[])

    def init(**options):
        calls.begun.append(options)
        return SimpleNamespace(
            log=lambda values, step: calls.logged.append((step, values)),
            finish=lambda: calls.finished.append(True),
        )

    monkeypatch.setitem(sys.modules, "wandb", SimpleNamespace(init=init))
    return calls


@only_long
def test_every_logger_receives_training_and_evaluation(workplace, wandb, monkeypatch):
    monkeypatch.delenv("WANDB_MODE", raising=False)
    arguments = [*TRAINED, "--loggers", "tensorboard", "wandb", "--record"]
    assert running.main(LAKE, arguments) == 0
    (row,) = results.read(workplace / "results" / "lake.jsonl")
    (folder,) = (path for path in (workplace / "runs").iterdir() if path.is_dir())
    ((_, values), (last, measured)) = wandb.logged
    assert last == 4 and measured["evaluation/success"] == row["successes"] / row["episodes"]
    (metrics,) = csv.DictReader((folder / "metrics.csv").read_text().splitlines())
    assert values["training/loss"] == pytest.approx(float(metrics["loss"]))
    (begun,) = wandb.begun
    assert begun["mode"] == "offline" and begun["id"] == row["hash"] and wandb.finished == [True]
    assert begun["config"]["training"]["steps"] == 4
    everything = {**values, **measured}
    found, _ = read(folder / "tensorboard")
    assert {name: value for name, step, value in found if step == 4} == pytest.approx(everything)
    (played,) = results.read_episodes(workplace / "results" / "lake.jsonl").values()
    assert played["seed"].tolist() == [10_000_000 + i for i in range(3)]
    assert played["success"].sum() == row["successes"]
    assert played["return"].mean() == pytest.approx(row["mean_return"])
    assert played["length"].mean() == pytest.approx(row["mean_length"])


def test_a_resumed_run_tells_loggers_where_it_resumes(tmp_path, wandb, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "online")  # set by the user
    about = loggers.About(tmp_path, "abc", {}, 40)
    with loggers.open_loggers(["wandb", "tensorboard"], lambda: about) as log:
        assert not wandb.begun  # the first value opens the loggers
        log(60, {"training/loss": 0.5})
    assert wandb.begun[0]["mode"] == "online" and wandb.begun[0]["resume"] == "allow"
    # Step 40 was logged before: TensorBoard drops values of earlier files from step 41 on.
    assert read(tmp_path / "tensorboard") == ([("training/loss", 60, 0.5)], [41])


def test_a_resumed_run_drops_the_measurements_of_lost_steps(tmp_path):
    curve = [{"step": step, "seconds": step / 10, "loss": 1.0} for step in (20.0, 40.0)]
    metrics.write_metrics(tmp_path, curve)
    assert metrics.resume_metrics(tmp_path, 30) == metrics.read_metrics(tmp_path) == curve[:1]
    assert metrics.resume_metrics(tmp_path, 0) == metrics.read_metrics(tmp_path) == []


def test_unknown_and_missing_loggers_raise_an_error(monkeypatch):
    with pytest.raises(UserError, match="unknown logger 'csv': expected some of tensorboard"):
        command_line.parse("babyai", ["--loggers", "csv"])
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(UserError, match=r'pip install "\.\[tensorboard\]"'):
        command_line.parse("babyai", ["--loggers", "tensorboard"])
