"""The measures of the whole keep their limits, and each commit that cuts lowers them."""

import json

from benchmarks import measures

LIMITS = json.loads(measures.LIMITS.read_text())


def test_every_measure_keeps_its_limit():
    found = measures.counts(measures.ROOT)
    assert found.keys() == LIMITS["whole"].keys() | LIMITS["parts"].keys()
    assert not measures.over(found, measures.limits())


def test_a_measure_above_its_limit_is_seen_and_no_limit_is_raised():
    found = measures.limits() | {"commands": LIMITS["whole"]["commands"] + 1, "README: words": 1}
    over = measures.over(found, measures.limits())
    assert over == {"commands": (found["commands"], found["commands"] - 1)}
    assert measures.lowered(found, LIMITS["whole"]) == LIMITS["whole"] | {"README: words": 1}


def test_files_are_counted(tmp_path):
    files = {
        "README.md": "two words\n",
        "uuvtai/__init__.py": "",
        "uuvtai/cli.py": "from uuvtai.low import deep\nfrom uuvtai import loose\n\nA = 1\n",
        "uuvtai/loose.py": "def f():\n    import uuvtai.cli\n    return 1\n",
        "uuvtai/low/deep.py": "import uuvtai.loose\n" * 60,
        "uuvtai/low/page.mjs": "start();\n",
        "uuvtai/presets/worlds/pool.yaml": "",
        "docs/page.md": "three words here\n",
        "docs/reference/made.md": "not counted\n",
        "docs/data/a.json": "12345",
        "tests/test_a.py": "\n\n",
        "tests/js/a.mjs": "\n",
        "benchmarks/b.py": "\n",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    assert measures.of_files(tmp_path) == {
        "package: lines": 67, "package: files with code": 2,
        "package: files under 60 lines, those without code too": 3,
        "package: files with code under 60 lines": 1, "package: folders and loose files at its top": 4,
        "package: floors": 3, "package: lines of JavaScript": 1, "package: preset files": 1,
        "docs: pages": 1, "docs: words": 3,
        "docs: lines of Python": 0, "README: lines": 1, "README: words": 2,
        "tests: lines of Python and JavaScript": 3, "benchmarks: lines": 1, "results and data: bytes": 5,
        "longest function": 3, "longest file but cli.py": 60, "cli.py": 4,
    }  # fmt: skip
