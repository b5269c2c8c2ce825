"""Logs and policies made to do harm end in one line, within seconds and little memory."""

import json
import os
import re
import struct
import subprocess
import sys
import textwrap
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.writer import MCAP0_MAGIC as MAGIC

from tests.command import run_cli
from tests.learning.export import test_deploy as deployed
from tests.oracles import logs as episode
from uuvtai.common.errors import UserError
from uuvtai.common.files import FileError
from uuvtai.learning.export import graph as graph_check
from uuvtai.learning.export.folder import of_onnx
from uuvtai.learning.export.graph import GraphError, refuse_strange
from uuvtai.logs.container import McapFile
from uuvtai.logs.drawing import Recording, load_recording
from uuvtai.logs.encode import LogError
from uuvtai.logs.export import export, repair
from uuvtai.logs.picture import picture
from uuvtai.logs.reader import LogHead, info, read_messages
from uuvtai.logs.rosbag import to_rosbag2
from uuvtai.logs.video import frame_times, video
from uuvtai.logs.writer import McapEpisodeLog

N_STEP = 60
BOUND_S, BOUND_MIB = 30, 1024
END = struct.pack("<BQI", 0x0F, 4, 0)


@pytest.fixture(scope="module")
def log_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    with McapEpisodeLog(path, episode.header()) as log:
        for snap in episode.snapshots(N_STEP):
            log.write(snap)
        log.close(episode.result(N_STEP))
    return path


def bounded(work, tmp_path):
    """Run ``work`` in a process under BOUND_S and BOUND_MIB above its imports; its one line of refusal."""
    code = f"""
    import resource
    from pathlib import Path
    import pytest
    from uuvtai.common.errors import UserError
    from uuvtai.logs import export, reader
    here = Path({str(tmp_path)!r})
    begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        print("accepted", {work})
    except UserError as error:
        print(str(error).replace(chr(10), " "))
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - begun) // 1024)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)], capture_output=True, text=True, timeout=BOUND_S + 30,
        check=False, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    *answer, mib = done.stdout.splitlines()
    assert int(mib) < BOUND_MIB
    return "\n".join(answer)


def record_of(opcode, content):
    return struct.pack("<BQ", opcode, len(content)) + content


def chunk_of(plain, name=b"zstd", data=None, claimed=None, crc=0):
    """A chunk of ``plain``, or of ``data`` that claims to unpack to ``claimed`` bytes."""
    data = zstandard.ZstdCompressor().compress(plain) if data is None else data
    size = len(plain) if claimed is None else claimed
    head = struct.pack("<QQQII", 0, 0, size, crc, len(name)) + name
    return record_of(6, head + struct.pack("<Q", len(data)) + data)


# -------------------------------------------------------------------------------------------- cut and spoilt


ZEROS = bytes(200 << 20)
ZSTD_BOMB = zstandard.ZstdCompressor().compress(ZEROS)
OPEN_BOMB = zstandard.ZstdCompressor(write_content_size=False).compress(ZEROS)
LZ4_BOMB = lz4.frame.compress(ZEROS)
MESSAGE = record_of(5, struct.pack("<HIQQ", 9, 0, 0, 0) + b"{}")
NO_LOG, CUT = "is not an MCAP file", "its writing was cut off"
REFUSED = r"unpack to .* bytes|did not decompress full frame"
SPOILT = {
    "an empty file": (b"", NO_LOG),
    "other magic": (b"\x89PNG\r\n\x1a\n" + END, NO_LOG),
    "three bytes": (MAGIC[:3], NO_LOG),
    "magic alone": (MAGIC, CUT),
    "a record of 2^60 bytes": (MAGIC + struct.pack("<BQ", 9, 1 << 60) + b"abc", "exceeds limit"),
    "a record longer than the file": (MAGIC + struct.pack("<BQ", 9, 1 << 20) + b"abc", CUT),
    "a record half there": (MAGIC + struct.pack("<BI", 9, 1), CUT),
    "an attachment of 2^60 bytes within": (
        MAGIC + record_of(9, struct.pack("<QQIIQ", 0, 0, 0, 0, 1 << 60)) + END,
        "a record holds 1152921504606846976 bytes",
    ),
    "a message of 65 MiB": (MAGIC + struct.pack("<BQ", 5, 65 << 20), "exceeds limit"),
    "a message too short for its head": (MAGIC + record_of(5, bytes(21)) + END, "a record holds -1 bytes"),
    "a channel of half a word": (
        MAGIC + record_of(4, struct.pack("<HHI", 1, 0, 2) + b"\xff\xff") + END,
        "utf-8",
    ),
    "an unknown compression": (MAGIC + chunk_of(b"", b"brot", b"abc", 3) + END, "unknown compression 'brot'"),
    "no zstd": (MAGIC + chunk_of(b"", b"zstd", b"abc", 3) + END, "content size"),
    "no lz4": (MAGIC + chunk_of(b"", b"lz4", b"abc", 3) + END, "does not unpack to 3 bytes"),
    "a wrong checksum": (MAGIC + chunk_of(MESSAGE, crc=1) + END, "crc validation failed"),
    "a chunk that ends within a record": (MAGIC + chunk_of(MESSAGE + b"\5\1") + END, "before byte"),
    **{
        f"a bomb of {name.decode()} that claims {claimed} bytes": (
            MAGIC + chunk_of(b"", name, data, claimed) + END,
            REFUSED,
        )
        for name, data in ((b"zstd", ZSTD_BOMB), (b"zstd", OPEN_BOMB), (b"lz4", LZ4_BOMB))
        for claimed in (1000 + len(data) % 7, len(ZEROS), 1 << 60)
    },
}
"""what is in a file: what is said of it"""


@pytest.mark.parametrize(("content", "says"), SPOILT.values(), ids=SPOILT)
def test_what_is_spoilt_is_said_in_one_line_by_every_tool(tmp_path, content, says):
    path = tmp_path / "a.mcap"
    path.write_bytes(content)
    for tool in (
        info,
        lambda path: list(read_messages(path)),
        lambda path: export(path, tmp_path / "out"),
        repair,
    ):
        with pytest.raises(LogError, match=says) as refused:
            tool(path)
        said = str(refused.value)
        assert said.startswith(str(path)) and "\n" not in said
        assert re.search("uuv log repair|record the episode again|uuv eval --record wrote", said)
    assert [entry.name for entry in tmp_path.iterdir()] == ["a.mcap"]


def test_bombs_take_no_memory(tmp_path):
    for i, (content, _says) in enumerate(SPOILT.values()):
        (tmp_path / f"{i}.bad").write_bytes(content)
    (tmp_path / "a.ok").write_bytes(MAGIC + chunk_of(record_of(0x85, bytes(60 << 20))) * 8 + END)
    works = ["[reader.info(path)['messages'] for path in here.glob('*.ok')]"]
    for tool in ("reader.info", "export.repair"):
        works.append(f"len([pytest.raises(UserError, {tool}, path) for path in here.glob('*.bad')])")
    assert bounded(", ".join(works), tmp_path) == f"accepted [0] {len(SPOILT)} {len(SPOILT)}"


def test_a_message_of_an_undeclared_channel(tmp_path):
    (tmp_path / "a.mcap").write_bytes(MAGIC + chunk_of(MESSAGE) + END)
    with pytest.raises(LogError, match="channel 9, which was never declared"):
        list(read_messages(tmp_path / "a.mcap"))


def test_a_bad_index_is_not_looked_at(log_path, tmp_path):
    whole = log_path.read_bytes()
    with log_path.open("rb") as file:
        begin = make_reader(file).get_summary().chunk_indexes[-1]
    at = begin.chunk_start_offset + begin.chunk_length + begin.message_index_length
    (tmp_path / "a.mcap").write_bytes(whole[:at] + whole[at:].replace(struct.pack("<Q", at), bytes(8)))
    spoilt = bytearray(whole)
    spoilt[-200:-8] = b"\xff" * 192
    (tmp_path / "b.mcap").write_bytes(spoilt)
    for name in ("a.mcap", "b.mcap"):
        assert info(tmp_path / name)["messages"] == info(log_path)["messages"]
        assert repair(tmp_path / name).complete


def test_random_damage_is_an_error_or_costs_messages_but_makes_none(log_path, tmp_path):
    """Flipped bits, a run of other bytes, a cut: every tool works or raises LogError."""
    path, rng, failed = tmp_path / "a.mcap", np.random.default_rng(5), 0
    whole = log_path.read_bytes()
    known = {(m.topic, m.time_s, json.dumps(m.data)) for m in read_messages(log_path)}
    for trial in range(24):
        spoilt, at = bytearray(whole), int(rng.integers(8, 20_000 if trial % 2 else len(whole)))
        if trial % 3 == 0:
            spoilt[at] ^= 1 << int(rng.integers(8))
        elif trial % 3 == 1:
            spoilt[at : at + 8] = rng.bytes(int(rng.integers(1, 12)))
        else:
            del spoilt[at:]
        path.write_bytes(spoilt)
        for tool in (info, load_recording, lambda path: repair(path, force=True)):
            try:
                found = tool(path)
            except LogError:
                failed += 1
            else:
                if tool not in (info, load_recording):
                    kept = [(m.topic, m.time_s, json.dumps(m.data)) for m in read_messages(found.path)]
                    assert len(set(kept)) == len(kept) and set(kept) <= known
    assert failed > 25


# ----------------------------------------------------------------------------------------------- odd contents


GRID = {
    "pose": {"position": {"x": 0, "y": 0, "z": 0}},
    "cell_size": {"x": 0.1, "y": 0.1},
    "column_count": 2,
    "cell_stride": 4,
    "fields": [{"name": "other", "offset": 0, "type": 7}],
    "data": "AAAAAAAAAAA=",
}
ODD = {
    "a grid without value": GRID,
    "a grid of no columns": GRID | {"column_count": 0, "fields": [{"name": "value", "offset": 0}]},
    "an offset beyond": GRID | {"fields": [{"name": "value", "offset": 99}]},
    "an offset in words": GRID | {"fields": [{"name": "value", "offset": "x"}]},
    "fields as a number": GRID | {"fields": 3},
    "a list": [1, 2],
    "a number": 3,
    "null": None,
    "half a surrogate": {"x": "\ud800"},
    "nested": json.loads("[" * 800 + "]" * 800),
    "words as data": GRID | {"data": 5},
    "an image of nothing": {"format": "png", "data": "iVBORw0KGgo="},
}


def one_topic(path, data, topic="/map/static"):
    file = McapFile(path)
    file.add_attachment("scenario.json", "application/json", json.dumps(episode.scenario()).encode())
    pose = {"pose": {"position": {"x": 2, "y": 1, "z": -1}, "orientation": {"x": 0, "y": 0, "z": 0, "w": 1}}}
    file.add_message(
        file.add_channel("/pose", file.add_schema("p", "jsonschema", b"{}")), 0, json.dumps(pose).encode()
    )
    file.add_message(
        file.add_channel(topic, file.add_schema("s", "jsonschema", b"{}")), 0, json.dumps(data).encode()
    )
    file.finish()
    return path


@pytest.mark.parametrize("data", ODD.values(), ids=ODD)
def test_messages_unlike_their_schema_are_one_line(tmp_path, data):
    path = one_topic(tmp_path / "a.mcap", data)
    refused = 0
    for work in (
        lambda: picture(path, tmp_path / "a.png"),
        lambda: load_recording(path),
        *(lambda fmt=fmt: export(path, tmp_path / fmt, fmt=fmt) for fmt in ("json", "csv", "npz")),
    ):
        try:
            work()
        except UserError as error:
            refused += "\n" not in str(error)
    assert refused >= 2
    assert not list(tmp_path.glob(".*"))


def test_a_table_that_grows_with_every_message(tmp_path, monkeypatch):
    file = McapFile(tmp_path / "a.mcap")
    channel = file.add_channel("/wide", 0)
    for i in range(40):
        file.add_message(channel, i, json.dumps({f"{i}_{j}": 0 for j in range(1000)}).encode())
    file.finish()
    with pytest.raises(LogError, match="more than 20,000 columns"):
        export(tmp_path / "a.mcap", tmp_path / "out", fmt="csv")
    monkeypatch.setattr("uuvtai.logs.export.MAX_ARRAYS", 100_000)
    with pytest.raises(LogError, match="use --format json"):
        export(tmp_path / "a.mcap", tmp_path / "out", fmt="npz")
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


# ------------------------------------------------------------------------------------------ pipes and devices


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize("command", ["info", "picture", "video", "convert", "repair", "export"])
def test_a_pipe_is_not_waited_for(tmp_path, command):
    os.mkfifo(tmp_path / "a.mcap")
    works = {
        "info": info,
        "picture": lambda path: picture(path, tmp_path / "x.png"),
        "video": lambda path: video(path, tmp_path / "x.mp4"),
        "convert": lambda path: to_rosbag2(path, tmp_path / "x"),
        "repair": repair,
        "export": lambda path: export(path, tmp_path / "x"),
    }
    for path in (tmp_path / "a.mcap", Path("/dev/zero"), tmp_path):
        with pytest.raises((FileError, LogError), match=r"is a (pipe|device|folder)"):
            works[command](path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


# ---------------------------------------------------------------------------------------------------- outputs


@pytest.mark.parametrize("command", ["render", "convert", "repair"])
def test_no_output_is_the_input_or_replaces_a_file(log_path, tmp_path, command, capfd):
    mine, log = tmp_path / "mine", tmp_path / "a.mcap"
    mine.write_text("precious")
    log.write_bytes(log_path.read_bytes())
    (tmp_path / "link.mcap").symlink_to(log)
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    for out in (log, tmp_path / "link.mcap", mine, tmp_path / "dangling", tmp_path / "sub" / ".." / "a.mcap"):
        assert run_cli("log", command, log, "--out", out) == 2
    force = () if command == "convert" else ("--force",)
    for out in (log, tmp_path / "link.mcap", tmp_path / "dangling"):
        assert run_cli("log", command, log, "--out", out, *force) == 2
    said = capfd.readouterr().err
    assert said.count("is already there") >= 1 and said.count("is what is read here") >= 4
    assert "Traceback" not in said
    assert mine.read_text() == "precious" and log.read_bytes() == log_path.read_bytes()
    assert not (tmp_path / "nothing").exists()


def test_a_log_cannot_plant_files_in_a_folder_that_is_there(tmp_path, capfd):
    file = McapFile(tmp_path / "a.mcap")
    names = [
        "conftest.py", "Makefile", "../conftest.py", "CON", "nul.txt", "a", "A", "-rf", "x.", "metadata.json",
    ]  # fmt: skip
    for name in names:
        file.add_attachment(name, "", name.encode())
    file.add_message(file.add_channel("/a", 0), 0, b'{"x": 1}')
    file.add_message(file.add_channel("/A", 0), 0, b'{"x": 2}')
    file.finish()
    project = tmp_path / "project"
    project.mkdir()
    (project / "conftest.py").write_text("mine")
    assert run_cli("log", "export", tmp_path / "a.mcap", "--out", project) == 2
    assert "not empty" in capfd.readouterr().err
    assert [path.name for path in project.iterdir()] == ["conftest.py"]
    assert (project / "conftest.py").read_text() == "mine"
    (tmp_path / "link").symlink_to(tmp_path)
    assert run_cli("log", "export", tmp_path / "a.mcap", "--out", tmp_path / "link") == 2
    (tmp_path / "new").mkdir()
    assert run_cli("log", "export", tmp_path / "a.mcap", "--out", tmp_path / "new", "--format", "csv") == 0
    kept = sorted(path.name for path in (tmp_path / "new" / "attachments").iterdir())
    assert len({name.casefold() for name in kept}) == len(names)
    assert not {"CON", "nul.txt"} & set(kept)
    assert not any(name.startswith("-") or name.endswith(".") for name in kept)
    assert sorted(path.name for path in (tmp_path / "new").glob("*.*")) in (
        ["A_2.csv", "a.csv", "metadata.json"],
    )
    assert run_cli("log", "export", tmp_path / "a.mcap", "--out", tmp_path / "again", "--format", "xls") == 2


# ------------------------------------------------------------------------------------------ exported policies


INPUTS = {"obs": (64, 40), "last_obs": (64, 40), "last_action": (64, 4), "has_last": (64,)}


def graph_of(nodes, weights=(), **words):
    onnx = pytest.importorskip("onnx", reason="needs the extra uuvtai[export]")
    helper, kinds = onnx.helper, onnx.TensorProto
    values = [
        helper.make_tensor_value_info(
            name, kinds.BOOL if name == "has_last" else kinds.FLOAT, ["rows", *shape[1:]]
        )
        for name, shape in INPUTS.items()
    ]
    made = [helper.make_node(*node[:3], **(node[3] if len(node) > 3 else {})) for node in nodes]
    out = helper.make_tensor_value_info(nodes[-1][2][0], kinds.FLOAT, None)
    tensors = [onnx.numpy_helper.from_array(np.asarray(array), name) for name, array in weights]
    graph = helper.make_graph(made, "g", values, [out], initializer=tensors)
    return helper.make_model(
        graph, opset_imports=[helper.make_opsetid("", words.get("opset", 20))]
    ).SerializeToString()


BIG = ("n", np.array([100_000, 100_000], np.int64))
STRANGE = {
    "a tensor of gigabytes, summed": (
        [("ConstantOfShape", ["n"], ["x"]), ("ReduceSum", ["x"], ["y"], {"keepdims": 0})],
        [BIG],
        "more than 256 MiB",
    ),
    "a shape that depends on values": (
        [("Cast", ["last_action"], ["n"], {"to": 7}), ("ConstantOfShape", ["n"], ["x"])],
        [],
        "cannot be told|does not fit",
    ),
    "doubled thirty times": ([("Concat", [f"x{i}"] * 2, [f"x{i + 1}"], {"axis": 1}) for i in range(30)],
        [("x0", np.ones((1, 1), "f4"))], "more than 256 MiB"),
    "a column by a row": ([("Transpose", ["w"], ["t"]), ("Mul", ["w", "t"], ["x"])],
        [("w", np.ones((9999, 1), "f4"))], "more than 256 MiB"),
    "one row laid out a million times": ([("Expand", ["last_action", "n"], ["x"])],
        [("n", np.array([1_000_000, 64, 4], np.int64))], "more than 256 MiB"),
    "long work": ([("MatMul", ["w" if i == 0 else f"x{i}", "w"], [f"x{i + 1}"]) for i in range(40)],
        [("w", np.ones((400, 400), "f4"))], "multiplications"),
    **{
        f"operator {name}": ([(name, ["obs"], ["x"])], [], f"has onnx.{name}")
        for name in (
            "Tile", "Range", "Resize", "RandomNormalLike", "NonZero", "Loop", "If", "Scan", "Pad", "OneHot",
            "Einsum",
        )
    },
}  # fmt: skip


@pytest.mark.parametrize(("nodes", "weights", "says"), STRANGE.values(), ids=STRANGE)
def test_graphs_that_take_memory_or_time_never_reach_onnx_runtime(nodes, weights, says, monkeypatch):
    monkeypatch.setattr(
        "uuvtai.learning.export.graph.session", lambda _graph: pytest.fail("ONNX Runtime saw it")
    )
    graph = graph_of(nodes, weights)
    with pytest.raises(GraphError, match=says):
        of_onnx(
            graph,
            {
                f"pair_{name}": np.zeros(shape, bool if name == "has_last" else np.float32)
                for name, shape in INPUTS.items()
            },
            INPUTS,
        )


def test_what_a_graph_says_of_its_own_shapes_is_not_believed():
    onnx = pytest.importorskip("onnx", reason="needs the extra uuvtai[export]")
    model = onnx.load_from_string(
        graph_of([("ConstantOfShape", ["n"], ["x"]), ("ReduceSum", ["x"], ["y"])], [BIG])
    )
    model.graph.value_info.append(onnx.helper.make_tensor_value_info("x", onnx.TensorProto.FLOAT, [1, 1]))
    with pytest.raises(GraphError, match="more than 256 MiB"):
        refuse_strange(model.SerializeToString(), INPUTS, 1)


def test_old_or_foreign_operator_sets_and_other_inputs_are_refused():
    add = [("Add", ["obs", "last_obs"], ["x"])]
    refuse_strange(graph_of(add), INPUTS, 330)
    with pytest.raises(GraphError, match="has opset onnx 8"):
        refuse_strange(graph_of(add, opset=8), INPUTS, 1)
    with pytest.raises(GraphError, match="takes has_last"):
        refuse_strange(graph_of(add), {"obs": (64, 40)}, 1)
    assert not {"Loop", "If", "Scan", "Tile", "Range", "Resize", "NonZero"} & graph_check.OPERATORS
    assert not any("Random" in name or "Sequence" in name for name in graph_check.OPERATORS)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    root = tmp_path_factory.mktemp("export")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(deployed.deploy, "missing_packages", lambda: ["onnx"])
        deployed.exported(deployed.saved(root / "run"), root / "out")
    return root / "out"


@pytest.fixture
def folder(exported, tmp_path):
    return Path(deployed.shutil.copytree(exported, tmp_path / "out"))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes here")
@pytest.mark.parametrize(
    "name", ["policy_spec.json", "policy.safetensors", "golden.safetensors", "README.md"]
)
def test_a_pipe_in_an_exported_folder_is_not_waited_for(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    done = subprocess.run(
        [sys.executable, folder / "run_policy.py"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 1 and "no plain file" in done.stderr and "Traceback" not in done.stderr


def test_only_an_exported_policy_is_replaced(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(deployed.deploy, "missing_packages", lambda: ["onnx"])
    found = deployed.saved(tmp_path / "run")
    (folder / "policy_spec.json").write_text("{}")
    assert deployed.deploy.export(found, "mine", folder, (), lambda _text: None, force=True)["agrees"]
    assert json.loads((folder / "policy_spec.json").read_text())["name"] == "mine"
    (folder / "thesis.txt").write_text("precious")
    with pytest.raises(UserError, match="is not just an exported policy"):
        deployed.deploy.export(found, "mine", folder, (), lambda _text: None, force=True)
    assert (folder / "thesis.txt").read_text() == "precious"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out", "run"]


@pytest.mark.parametrize(("poses", "is_watched"), [(2, False), (100, False), (180_000, True)])
def test_a_small_file_cannot_order_an_hour_of_frames(poses, is_watched):
    recording = Recording(Path("x.mcap"), LogHead(), {})
    recording["/pose"].times.extend(np.linspace(0.0, 3600.0, poses))
    if is_watched:
        assert len(frame_times(recording, 15.0, 1.0)) == 3600 * 15 + 16
    else:
        with pytest.raises(
            LogError, match=f"{poses} poses in 3,600 s are no episode to watch; raise --speed"
        ):
            frame_times(recording, 15.0, 1.0)
