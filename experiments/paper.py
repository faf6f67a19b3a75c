"""The paper's numbers (table 1): success on BabyAI in percent."""

METHODS = ("bc", "bcq", "iql", "dt", "plate", "mopo", "leap")
SUCCESS = {
    "GoToLocalS7N5": (71.0, 71.5, 84.5, 73.0, 42.5, 87.0, 91.0),
    "GoToLocalS8N7": (61.5, 63.0, 71.5, 63.5, 45.0, 81.5, 95.0),
    "GoToObjMazeS4": (24.0, 23.0, 52.5, 46.5, 35.5, 60.0, 62.5),
    "GoToObjMazeS7": (18.0, 10.5, 29.0, 22.0, 27.5, 30.5, 42.5),
    "GoToObjMazeS4R2Close": (24.0, 22.5, 31.5, 48.5, 32.5, 36.0, 55.0),
    "PickUpLoc": (57.5, 58.5, 41.0, 59.5, 7.5, 43.5, 67.0),
    "GoToSeqS5R2": (13.5, 10.0, 28.5, 26.5, 25.0, 30.0, 33.0),
}


def list_success(level: str) -> dict[str, float]:
    """Returns the paper's success rates on a level in percent, by method; empty if unknown."""
    return dict(zip(METHODS, SUCCESS.get(level, ()), strict=False))


def find_success(level: str, method: str) -> float | None:
    """Returns the paper's success rate of a method on a level in percent, `None` if unknown."""
    return list_success(level).get(method)
