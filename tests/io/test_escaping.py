"""Names from files where they are shown."""

from __future__ import annotations

import json
from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.text import Text

from tdanet_jax.io import escaping

HOSTILE = "\x1b]0;a\x07\x1b[2J\u202eb[/x][red]$x^$|<b>&`*c*\\"


def test_a_terminal_gets_no_control_characters() -> None:
    text = escaping.in_terminal(f"{HOSTILE}\ntwo\r\tthree")
    assert text.splitlines() == ["?]0;a??[2J?b[/x][red]$x^$|<b>&`*c*\\", "two??three"]
    assert escaping.in_line("a\n  b\x1b\tc") == "a b? c"
    assert escaping.in_line("abcdef", 3) == "abc ..."


def test_dollars_make_no_formula() -> None:
    axes = Figure().subplots()
    text: Text = axes.text(0, 0, escaping.in_figure(r"a$\frac{1}$b \$ $"))
    assert text._preprocess_math(text.get_text()) == (r"a$\frac{1}$b \$ $", False)  # type: ignore[attr-defined]


def test_a_cell_of_a_table_stays_one() -> None:
    assert escaping.in_markdown("a|b\n<b>&[c](d) *e* `f` \\") == (
        r"a\|b &lt;b&gt;&amp;\[c\](d) \*e\* \`f\` " + "\\\\"
    )
    assert escaping.in_markdown("living_room, --odometry 18/4") == "living_room, --odometry 18/4"


def test_a_script_does_not_end() -> None:
    value = {"name": "</script><!--&" + HOSTILE}
    text = escaping.in_script(value)
    assert not set("<>&") & set(text)
    assert json.loads(text) == value


def test_nothing_is_printed_past_the_console() -> None:
    """`print` and `sys.stdout` are used in commands/console.py alone, to say in words of our own
    that the output broke, and for answers in JSON, which escapes.
    """
    root = Path(__file__).parents[2] / "tdanet_jax"
    allowed = {"commands/console.py", "commands/streams.py", "commands/serve.py"}
    found = {
        path.relative_to(root).as_posix()
        for path in root.rglob("*.py")
        if any(
            line.lstrip().startswith(("print(", "sys.stdout.write(", "sys.stderr.write("))
            for line in path.read_text(encoding="utf-8").splitlines()
        )
    }
    assert found <= allowed
