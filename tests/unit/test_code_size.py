"""Limits of the packages' code: arguments, lines of a file, private parts of Numba."""

import ast
from pathlib import Path

ROOT = Path(__file__).parents[2]
FILES = [
    p for name in ("road_envs", "estimators", "leaderboard") for p in (ROOT / name).rglob("*.py")
]
MAX_POSITIONAL, MAX_LINES = 7, 450


def positional(function: ast.FunctionDef) -> int:
    """Number of arguments that can be given by position, without `self` and `cls`."""
    names = [each.arg for each in (*function.args.posonlyargs, *function.args.args)]
    return len(names) - (names[:1] in (["self"], ["cls"]))


def is_kernel(function: ast.FunctionDef) -> bool:
    return any("kernel" in ast.unparse(each) for each in function.decorator_list)


def test_no_function_but_a_kernel_has_more_than_seven_positional_arguments():
    functions = [
        (f"{path.relative_to(ROOT)}:{node.lineno} {node.name}", positional(node))
        for path in FILES
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.FunctionDef) and not is_kernel(node)
    ]
    assert len(functions) > 2000
    assert [where for where, count in functions if count > MAX_POSITIONAL] == []


def test_no_file_is_much_longer_than_400_lines():
    sizes = {p: p.read_text(encoding="utf-8").count("\n") for p in FILES}
    assert {str(p.relative_to(ROOT)): n for p, n in sizes.items() if n > MAX_LINES} == {}


def imported(path: Path) -> set[str]:
    """Names of the modules that a file imports, wherever the statement stands."""
    nodes = list(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))
    plain = {each.name for node in nodes if isinstance(node, ast.Import) for each in node.names}
    return plain | {str(node.module) for node in nodes if isinstance(node, ast.ImportFrom)}


def test_one_file_leans_on_private_parts_of_numba():
    private = ("numba.core", "numba.np")
    files = {
        str(p.relative_to(ROOT)) for p in FILES if any(x.startswith(private) for x in imported(p))
    }
    assert files == {"road_envs/kernels/_numba.py"}
