import importlib.util
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
_spec = importlib.util.spec_from_file_location("check_kernels", ROOT / "tools/check_kernels.py")
assert _spec is not None
assert _spec.loader is not None
check_kernels = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(check_kernels)

GOOD = '''
import warp as wp

@wp.func
def helper(values: wp.array[float], i: int) -> float:
    return values[i]

@wp.kernel(enable_backward=False)
def _scale(x_in: wp.array2d[float], y_in: wp.array(dtype=float), k: float, z_out: wp.array[float]):
    """One element: z = k x."""
    i = wp.tid()
    local = wp.vec3()
    local[0] = x_in[i, 0]
    z_out[i] = k * local[0]

def scale(x, y, *, z):
    wp.launch(_scale, dim=3, inputs=[x, y, 2.0], outputs=[z], device=z.device)
    wp.launch_tiled(_scale, dim=3, inputs=[], outputs=[z], device=z.device, block_dim=32)
'''


def test_a_file_that_follows_the_rules_passes():
    assert check_kernels.check_source(GOOD) == []


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("def _scale", "def scale_kernel", "scale_kernel is public"),
        ('    """One element: z = k x."""\n', "", "no docstring"),
        ("x_in: wp.array2d[float]", "x: wp.array2d[float]", "array x of _scale"),
        ("y_in: wp.array(dtype=float)", "y: wp.array(dtype=float)", "array y of _scale"),
        ("k: float", "k", "argument k of _scale has no type"),
        ("    z_out[i] =", "    x_in[i, 0] =", "writes x_in"),
        ("    z_out[i] =", "    y_in[i] +=", "writes y_in"),
        ("dim=3, inputs=[x, y, 2.0], ", "dim=3, ", "launch without inputs="),
        ("outputs=[z], device=z.device)", "outputs=[z])", "launch without device="),
        ("outputs=[z], device=z.device, block", "block", "launch without outputs=, device="),
        ("*, z):\n", "*, z):\n    t = wp.zeros(3, dtype=float)\n", "wp.zeros"),
        ("*, z):\n", "*, z):\n    if z:\n        t = wp.empty_like(z)\n", "wp.empty_like"),
    ],
)
def test_each_broken_rule_is_found_once(old, new, words):
    assert old in GOOD
    problems = check_kernels.check_source(GOOD.replace(old, new, 1), "f.py")
    assert len(problems) == 1
    assert words in problems[0]
    assert problems[0].startswith("f.py:")


def test_the_command_prints_and_fails(tmp_path, capsys):
    bad, good = tmp_path / "bad.py", tmp_path / "good.py"
    bad.write_text(GOOD.replace("def _scale", "def scale_kernel"))
    good.write_text(GOOD)
    assert check_kernels.main([str(good)]) == 0
    assert check_kernels.main([str(good), str(bad)]) == 1
    assert str(bad) in capsys.readouterr().out


def test_the_projects_kernels_follow_the_rules():
    files = sorted(check_kernels.KERNELS.glob("*.py"))
    assert len(files) > 3
    problems = [
        problem
        for file in files
        for problem in check_kernels.check_source(file.read_text("utf-8"), file.name)
    ]
    assert problems == []
