"""python -m benchmarks: the checks that take minutes, and how long each takes on two processor cores."""

import ast
from pathlib import Path

for file in sorted(Path(__file__).parent.glob("[a-z]*.py")):
    summary = ast.get_docstring(ast.parse(file.read_text())) or ""
    print(f"python -m benchmarks.{file.stem:<24} {summary.splitlines()[0] if summary else ''}")
