"""Checks an installed wheel outside its checkout; `make package` runs this file."""

import re
import sys
from pathlib import Path

import leapjax
import leapjax.__main__

readme, site = Path(sys.argv[1]), Path(sys.argv[2]).resolve()
assert Path(leapjax.__file__).is_relative_to(site), leapjax.__file__
assert (Path(leapjax.__file__).parent / "py.typed").exists()
names: dict = {}
for snippet in re.findall(r"```python\n(.*?)```", readme.read_text(), flags=re.DOTALL):
    exec(compile(snippet, "README.md", "exec"), names)
assert names["plans"].satisfied.all()
assert leapjax.__main__.main(["--help"]) == 0
options = ["--level", "GoToLocalS7N5", "--pretrained", "--episodes", "5", "--no-pictures"]
assert leapjax.__main__.main(["babyai", *options]) == 0
