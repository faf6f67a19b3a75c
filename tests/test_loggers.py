"""Where measurements go, and what is kept of every episode."""

import csv
import io
import struct
import sys
from types import SimpleNamespace

import pytest
from rich.console import Console

from leapjax import domains
from leapjax.errors import UserError
from leapjax.running import command_line, loggers, progress, results
from leapjax.running import main as running
from tests.frozen_lake import FROZEN_LAKE
from tests.programs import LAKE, SMALL, only_long

TRAINED = [*SMALL, "--demos", "3", "--steps", "4"]


def events(folder):
    """All that TensorBoard's files hold: (name, step, value)."""
    return [
        (v.tag, event.step, v.simple_value) for event in read(folder) for v in event.summary.value
    ]


def read(folder):
    """The events of TensorBoard's files."""
    event_pb2 = pytest.importorskip("tensorboardX.proto.event_pb2")
    found = []
    for path in sorted(folder.iterdir()):
        data, place = path.read_bytes(), 0
        while place < len(data):  # length, its checksum, record, its checksum
            (length,) = struct.unpack("<Q", data[place : place + 8])
            found.append(event_pb2.Event.FromString(data[place + 12 : place + 12 + length]))
            place += length + 16
    return found


@pytest.fixture
def workplace(tmp_path, monkeypatch, quick_begin):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(domains.DOMAINS, LAKE.domain, FROZEN_LAKE)
    return tmp_path


@pytest.fixture
def sent(monkeypatch):
    """What Weights & Biases was given, in its place."""
    heard = SimpleNamespace(begun=[], logged=[], finished=0)

    def init(**options):
        heard.begun.append(options)
        return SimpleNamespace(
            log=lambda values, step: heard.logged.append((step, values)), finish=finish
        )

    def finish():
        heard.finished += 1

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
    assert begun["mode"] == "offline" and begun["id"] == row["hash"] and sent.finished == 1
    assert begun["config"]["training"]["steps"] == 4
    everything = {**values, **measured}
    assert {name: value for name, step, value in events(folder / "tensorboard") if step == 4} == (
        pytest.approx(everything)
    )
    (played,) = results.read_episodes(workplace / "results" / "lake.jsonl").values()
    assert played["seed"].tolist() == [10_000_000 + i for i in range(3)]
    assert played["success"].sum() == row["successes"]
    assert played["return"].mean() == pytest.approx(row["mean_return"])
    assert played["length"].mean() == pytest.approx(row["mean_length"])


def test_a_run_that_goes_on_says_where_it_began(tmp_path, sent, monkeypatch):
    monkeypatch.setenv("WANDB_MODE", "online")  # asked for
    about = loggers.About(tmp_path, "abc", {}, 40)
    with loggers.opened(["wandb", "tensorboard"], lambda: about) as log:
        assert not sent.begun  # with the first value, and not before
        log(60, {"training/loss": 0.5})
    assert sent.begun[0]["mode"] == "online" and sent.begun[0]["resume"] == "allow"
    assert events(tmp_path / "tensorboard") == [("training/loss", 60, 0.5)]
    # TensorBoard drops what earlier files have from there on: step 40 was logged, and is not again.
    begun = [
        event.step for event in read(tmp_path / "tensorboard") if event.HasField("session_log")
    ]
    assert begun == [41]


def test_loggers_that_there_are_not_are_one_line(monkeypatch):
    with pytest.raises(UserError, match="unknown logger 'csv': expected some of tensorboard"):
        command_line.parse("babyai", ["--loggers", "csv"])
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    with pytest.raises(UserError, match=r'pip install "\.\[tensorboard\]"'):
        command_line.parse("babyai", ["--loggers", "tensorboard"])


def test_a_log_says_how_long_it_will_take_once_that_is_known(monkeypatch):
    monkeypatch.setattr(progress, "LOG_INTERVAL", 0.0)
    out = io.StringIO()
    with progress.Meter(Console(file=out, width=100), "games", 10) as meter:
        meter.update(0)
        meter.update(10, "score 3")
    first, last = out.getvalue().splitlines()
    assert first.split() == ["games", "0/10", "0.0/s", "ETA", "unknown"]
    assert last.startswith("games 10/10 ") and last.endswith("ETA 0s  score 3")
