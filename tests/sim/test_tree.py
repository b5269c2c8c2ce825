"""Behaviour trees: reading, flattening, showing, and the tick engine against py_trees."""

import io
import xml.etree.ElementTree as ET
from itertools import pairwise

import numpy as np
import pytest
from rich.console import Console

from benchmarks.peers.tick_py_trees import PyTree
from docs.writers.palettes import with_palette
from tests.bundles import Stage, put
from uuvtai.common import tree_codes as codes
from uuvtai.common.presets import preset_names
from uuvtai.config.behavior import TUNED
from uuvtai.config.loader import ConfigError, preset_path
from uuvtai.console.screen import Screen
from uuvtai.console.views import show_tree
from uuvtai.kernels.behavior.io import BehaviorIO
from uuvtai.kernels.behavior.tree import tick_with_given_statuses
from uuvtai.sim import behavior_tree

N_BOARD = 20
"""Random blackboards per tree: one env each."""
N_TREE = 100
N_TICK = 6
MAX_NODE = 40
PRESETS = ("straight", "planner", "bt", "dwa", "mppi")


def xml(body: str, extra: str = "") -> str:
    return (
        '<root BTCPP_format="4" main_tree_to_execute="main"><BehaviorTree '
        f'ID="main">{body}</BehaviorTree>{extra}</root>'
    )


# ---------------------------------------------------------------------------------------------------- reading


def test_flattening_is_preorder_with_ends_and_parents():
    flat = behavior_tree.parse_tree(
        xml(
            '<Fallback name="top"><Sequence><HasRoute/><FollowRoute '
            'speed_m_s="0.4"/></Sequence><Inverter><Hold/></Inverter></Fallback>'
        )
    )
    assert flat.types == ("Fallback", "Sequence", "HasRoute", "FollowRoute", "Inverter", "Hold")
    assert flat.names[0] == "top" and flat.names[1] == "Sequence"
    assert flat.end == (6, 4, 3, 4, 6, 6)
    assert flat.parent == (-1, 0, 1, 1, 0, 4)
    assert flat.depth == (0, 1, 2, 2, 1, 2)
    assert flat.param[3] == (0.4, -1.0, -1.0, -1.0)
    assert flat.kind[2:4] == (codes.CONDITION, codes.ACTION)


def test_subtrees_are_put_in_place():
    flat = behavior_tree.parse_tree(
        xml(
            '<Sequence><SubTree ID="go" _autoremap="true"/><SubTree ID="go"/></Sequence>',
            '<BehaviorTree ID="go"><Hold/></BehaviorTree>',
        )
    )
    assert flat.types == ("Sequence", "Hold", "Hold")


def test_explicit_elements_are_the_same_as_compact_ones():
    compact = behavior_tree.parse_tree(xml('<Sequence><Stuck seconds="2"/><Unstick/></Sequence>'))
    explicit = behavior_tree.parse_tree(
        xml('<Control ID="Sequence"><Condition ID="Stuck" seconds="2"/><Action ID="Unstick"/></Control>')
    )
    assert compact == explicit


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (xml("<Sequence>\n<Evad/></Sequence>"), ("t.xml:2", "Evad", "did you mean 'Evade'")),
        (xml('<Hold name="stay"><Hold/></Hold>'), ("stay", "leaf")),
        (xml("<Sequence/>"), ("at least one child",)),
        (xml("<Inverter><Hold/><Hold/></Inverter>"), ("exactly one child",)),
        (xml("<Hold/><Hold/>"), ("exactly one node",)),
        (xml('<Stuck secs="1"/>'), ("unknown port 'secs'", "seconds")),
        (xml('<Stuck seconds="{t}"/>'), ("must be a number",)),
        (xml('<Stuck seconds="nan"/>'), ("must be a number",)),
        (xml('<Stuck seconds="-1"/>'), ("must be a number",)),
        (xml('<Sequence _skipIf="x"><Hold/></Sequence>'), ("_skipIf", "scripts")),
        (xml('<Condition ID="Hold"/>'), ("Action",)),
        (xml('<SubTree ID="man"/>'), ("did you mean 'main'",)),
        (xml("<Sequence>text<Hold/></Sequence>"), ("text",)),
        (xml("<Inverter>" * 70 + "<Hold/>" + "</Inverter>" * 70), ("nested",)),
        ("<root><BehaviorTree ID='a'><Hold/></BehaviorTree></root>", ("BTCPP_format",)),
        ("<tree/>", ("outermost",)),
        ('<root BTCPP_format="4"/>', ("no <BehaviorTree>",)),
        ('<root BTCPP_format="4"><include path="a.xml"/></root>', ("not included",)),
        (
            '<root BTCPP_format="4"><BehaviorTree ID="a"><Hold/></BehaviorTree><BehaviorTree '
            'ID="b"><Hold/></BehaviorTree></root>',
            ("main_tree",),
        ),
        (
            '<root BTCPP_format="4" main_tree_to_execute="z"><BehaviorTree '
            'ID="a"><Hold/></BehaviorTree></root>',
            ("'z'",),
        ),
        (
            '<root BTCPP_format="4"><BehaviorTree ID="a"><Hold/></BehaviorTree><BehaviorTree '
            'ID="a"><Hold/></BehaviorTree></root>',
            ("twice",),
        ),
        ("<root", ("t.xml:1", "not well-formed")),
        ("", ("not well-formed",)),
    ],
)
def test_bad_trees_are_refused_with_the_place_and_the_reason(text, words):
    with pytest.raises(behavior_tree.TreeError) as error:
        behavior_tree.parse_tree(text, "t.xml")
    for word in words:
        assert word in str(error.value)


def test_unknown_or_missing_files_are_refused(tmp_path):
    with pytest.raises(ConfigError, match="bt"):
        behavior_tree.read_tree("bt2")
    with pytest.raises(ConfigError, match="no such file"):
        behavior_tree.read_tree(str(tmp_path / "gone.xml"))
    path = tmp_path / "mine.xml"
    path.write_text(xml("<Hold/>"))
    assert behavior_tree.read_tree(str(path)).types == ("Hold",)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_open_in_groot(name):
    """Groot 2 needs format 4, a main tree, and every custom leaf in the palette with kind and ports."""
    assert set(preset_names("tree")) >= set(PRESETS)
    root = ET.parse(preset_path("tree", name)).getroot()
    assert root.attrib["BTCPP_format"] == "4"
    assert root.attrib["main_tree_to_execute"] in {tree.attrib["ID"] for tree in root.findall("BehaviorTree")}
    palette = {
        (entry.attrib["ID"], entry.tag, tuple(port.attrib["name"] for port in entry))
        for entry in root.find("TreeNodesModel")
    }
    wanted = {
        (leaf, "Action" if spec.kind == codes.ACTION else "Condition", spec.ports)
        for leaf, spec in behavior_tree.LEAVES.items()
    }
    assert palette == wanted
    text = preset_path("tree", name).read_text()
    assert with_palette(text) == text
    used = {node.tag for tree in root.findall("BehaviorTree") for node in tree.iter()} - {"BehaviorTree"}
    assert used <= {*behavior_tree.LEAVES, *behavior_tree.CONTROLS, *behavior_tree.DECORATORS}
    assert len(behavior_tree.read_tree(name).kind) <= codes.MAX_NODES


@pytest.mark.parametrize("width", [80, 100, 120])
@pytest.mark.parametrize("name", PRESETS)
def test_the_use_of_a_long_evaluation_fits_the_terminal(name, width):
    flat = behavior_tree.read_tree(name)
    ticks, acted = np.full((1000, 64), 99_999), np.full((1000, 64), 77_777)
    used = behavior_tree.node_use(ticks, acted, len(flat.kind))
    nodes = [{"type": kind, **vars(use)} for kind, use in zip(flat.types, used, strict=True)]
    console = Console(file=io.StringIO(), width=width)
    show_tree(Screen(False, console), behavior_tree.tree_text(flat), nodes)
    lines = console.file.getvalue().splitlines()
    assert max(map(len, lines)) <= width and "episodes" in lines[0]
    rows = [line for line in lines if "100.0 %" in line]
    assert len(rows) == len(flat.kind)
    if width == 120:
        for line, kind in zip(rows, flat.kind, strict=True):
            assert "99999000" in line and ("77777000" in line) is (kind == codes.ACTION)


def test_text_and_dot_name_every_node_and_its_use():
    flat = behavior_tree.read_tree("bt")
    ticks = np.zeros((4, 64), int)
    ticks[:, 0], ticks[:1, 1] = 10, 7
    acted = np.zeros((4, 64), int)
    acted[0, flat.types.index("FollowRoute")] = 5
    use = behavior_tree.node_use(ticks, acted, len(flat.kind))
    assert use[0].share == 1.0 and use[1].share == 0.25 and use[1].ticks == 7
    text, dot = behavior_tree.tree_text(flat), behavior_tree.tree_dot(flat, use)
    assert len(text.splitlines()) == len(flat.kind)
    for node in flat.names:
        assert node in text
    assert dot.count("->") >= len(flat.kind) - 1 and "25.0 %" in dot
    assert behavior_tree.node_use(np.zeros((0, 64)), np.zeros((0, 64)), 2)[1].ticks == 0
    quoted = behavior_tree.parse_tree(xml("<Hold name='a \"b\"'/>"))
    assert '\\"b\\"' in behavior_tree.tree_dot(quoted)


# ----------------------------------------------------------------------------------------------------- engine


@pytest.fixture(scope="module")
def engine():
    return Stage(n_env=N_BOARD, n_node=MAX_NODE, n_candidate=16, n_tuned=len(TUNED))


def begin(engine, flat):
    behavior_tree.load_tree(engine.table, flat)
    put(engine.behavior, status=0, running_child=0, ticks=0)


def tick(engine, answers):
    """Statuses [env, node] after a tick with the given leaf answers, and the acting node."""
    tick_with_given_statuses(engine.io(BehaviorIO), np.ascontiguousarray(answers, np.int32))
    return engine.behavior.status.to_numpy(), engine.behavior.leaf.to_numpy()


def random_tree(rng) -> behavior_tree.FlatTree:
    """A tree of at most MAX_NODE nodes, made as nested lists and flattened here, without the reader."""
    kind, end, parent = [], [], []

    def grow(above, depth):
        here = len(kind)
        leaf = depth >= 5 or len(kind) > MAX_NODE - 14 or (depth > 0 and rng.random() < 0.35)
        kind.append(
            int(rng.integers(codes.CONDITION, codes.ACTION + 1) if leaf else rng.integers(0, codes.CONDITION))
        )
        parent.append(above)
        end.append(0)
        if not leaf:
            for _ in range(1 if kind[here] >= codes.INVERTER else int(rng.integers(1, 4))):
                if len(kind) < MAX_NODE - 6:
                    grow(here, depth + 1)
            if len(kind) == here + 1:
                grow(here, 9)
        end[here] = len(kind)

    grow(-1, 0)
    n = len(kind)
    return behavior_tree.FlatTree(
        ("",) * n, ("",) * n, tuple(kind), tuple(end), tuple(parent), (-1,) * n, ((-1.0,) * 4,) * n
    )


def test_engine_equals_py_trees_node_by_node(engine):
    """100 random trees x 20 blackboards x 6 ticks: status, tick count and acting leaf."""
    rng = np.random.default_rng(7)
    compared = 0
    for _ in range(N_TREE):
        flat = random_tree(rng)
        n = len(flat.kind)
        begin(engine, flat)
        trees = [PyTree(flat) for _ in range(N_BOARD)]
        counts = np.zeros((N_BOARD, n), int)
        for _ in range(N_TICK):
            answers = rng.integers(codes.RUNNING, codes.FAILURE + 1, (N_BOARD, n))
            found, acting = tick(engine, answers)
            for env, tree in enumerate(trees):
                visited = tree.visited(answers[env])
                for node in visited:
                    counts[env, node] += 1
                assert tree.statuses() == found[env, :n].tolist(), (flat, answers[env])
                did = [
                    i for i in visited if flat.kind[i] == codes.ACTION and answers[env, i] != codes.FAILURE
                ]
                assert acting[env] == (did[-1] if did else -1)
                compared += n
        np.testing.assert_array_equal(engine.behavior.ticks.to_numpy()[:, :n], counts)
    assert compared > 40_000


def walk(engine, body, answers_by_type):
    """Statuses of env 0 after each tick; answers by leaf type."""
    flat = behavior_tree.parse_tree(xml(body))
    begin(engine, flat)
    rows = []
    for answers in answers_by_type:
        given = np.zeros((N_BOARD, len(flat.kind)), np.int32)
        for node, name in enumerate(flat.types):
            given[:, node] = answers.get(name, 0)
        found, acting = tick(engine, given)
        rows.append((found[0, : len(flat.kind)].tolist(), flat.types[acting[0]] if acting[0] >= 0 else None))
    return rows


R, S, F, IDLE = codes.RUNNING, codes.SUCCESS, codes.FAILURE, codes.IDLE


def test_memory_goes_on_and_reactive_begins_anew(engine):
    ticks = [{"Stuck": S, "Unstick": R}, {"Stuck": F, "Unstick": R}]
    assert walk(engine, "<Sequence><Stuck/><Unstick/></Sequence>", ticks)[1] == ([R, S, R], "Unstick")
    assert walk(engine, "<ReactiveSequence><Stuck/><Unstick/></ReactiveSequence>", ticks)[1] == (
        [F, F, IDLE],
        None,
    )


def test_priority_halts_what_ran_below(engine):
    emergency = "<ReactiveSequence><EmergencyTtc/><BackOff/></ReactiveSequence>"
    body = f"<ReactiveFallback>{emergency}<Sequence><Stuck/><Unstick/></Sequence></ReactiveFallback>"
    calm = {"EmergencyTtc": F, "Stuck": S, "Unstick": R}
    rows = walk(engine, body, [calm, {**calm, "EmergencyTtc": S, "BackOff": R}, {**calm, "Stuck": F}])
    assert rows[0] == ([R, F, F, IDLE, R, S, R], "Unstick")
    assert rows[1] == ([R, R, S, R, IDLE, IDLE, IDLE], "BackOff")
    assert rows[2] == ([F, F, F, IDLE, F, F, IDLE], None)  # the interrupted sequence began anew


def test_leaf_codes_are_distinct():
    used = sorted(leaf.code for leaf in behavior_tree.LEAVES.values())
    assert all(a < b for a, b in pairwise(used))
