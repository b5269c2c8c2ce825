"""Logs and exported policies made to do harm: each ends in one line, within seconds and a small part of the
memory, and harms no file."""

import json
import os
import struct
import subprocess
import sys
import textwrap
from pathlib import Path

import numpy as np
import pytest
import zstandard

from tests import test_deploy as deployed
from tests.command import run_cli
from tests.reference import logs as episode
from uuvtai.deploy import graph_check, run_policy
from uuvtai.deploy.agreement import of_onnx
from uuvtai.deploy.graph_check import GraphError, refuse_strange
from uuvtai.errors import UserError
from uuvtai.files import FileError
from uuvtai.logs import budget
from uuvtai.logs.container import MAGIC, McapFile
from uuvtai.logs.log_errors import LogError
from uuvtai.logs.log_export import export
from uuvtai.logs.mcap_log import McapEpisodeLog
from uuvtai.logs.picture import picture
from uuvtai.logs.reader import LogHead, info, read_messages
from uuvtai.logs.recording import Recording, load_recording
from uuvtai.logs.repair import repair
from uuvtai.logs.rosbag import from_rosbag2
from uuvtai.logs.video import frame_times, video

N_STEP = 60
BOUND_S, BOUND_MIB = 30, 1024
END = struct.pack("<BQI", 0x0F, 4, 0)
CHUNK = 6


@pytest.fixture(scope="module")
def log_path(tmp_path_factory):
    path = tmp_path_factory.mktemp("logs") / "a.mcap"
    with McapEpisodeLog(path, episode.header()) as log:
        for snap in episode.snapshots(N_STEP):
            log.write(snap)
        log.close(episode.result(N_STEP))
    return path


def bounded(work, tmp_path):
    """Run ``work`` in a process of its own under BOUND_S and BOUND_MIB above what it takes to import; its one
    line of refusal."""
    code = f"""
    import resource
    from pathlib import Path
    from uuvtai.errors import UserError
    from uuvtai.logs import log_export, reader, repair
    here = Path({str(tmp_path)!r})
    begun = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        print("accepted", {work})
    except UserError as error:
        print(str(error).replace(chr(10), " "))
    print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - begun) // 1024)
    """
    done = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(code)],
        capture_output=True,
        text=True,
        timeout=BOUND_S + 30,
        check=False,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    *answer, mib = done.stdout.splitlines()
    assert int(mib) < BOUND_MIB
    return "\n".join(answer)


def chunks(path):
    """[(place, record length, data length)] of the chunks of a log of ours."""
    content, found, at = path.read_bytes(), [], len(MAGIC)
    while content[at] != 0x0F:
        (length,) = struct.unpack_from("<Q", content, at + 1)
        if content[at] == CHUNK:
            found.append((at, length, *struct.unpack_from("<Q", content, at + 45)))
        at += 9 + length
    return found


def chunk_of(plain, compressed=None, claimed=None):
    data = zstandard.ZstdCompressor().compress(plain) if compressed is None else compressed
    size = len(plain) if claimed is None else claimed
    content = struct.pack("<QQQII4sQ", 0, 0, size, 0, 4, b"zstd", len(data)) + data
    return struct.pack("<BQ", CHUNK, len(content)) + content


# -------------------------------------------------------------------------------------------- time and memory


def test_chunks_that_each_unfold_to_their_limit(tmp_path):
    """What a chunk may unpack to, often, from a small file; in any command."""
    record = struct.pack("<BQ", 0x85, (15 << 20) - 9) + bytes((15 << 20) - 9)
    (tmp_path / "a.mcap").write_bytes(MAGIC + chunk_of(record) * 64 + END)
    assert (tmp_path / "a.mcap").stat().st_size < 1 << 20
    for work in (
        "reader.info(here / 'a.mcap')",
        "repair.repair(here / 'a.mcap')",
        "log_export.export(here / 'a.mcap', here / 'out')",
    ):
        assert "unpack to more than" in bounded(work, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


def test_chunks_that_claim_little_are_unpacked_no_further(tmp_path):
    bomb = zstandard.ZstdCompressor().compress(bytes(15 << 20))
    (tmp_path / "a.mcap").write_bytes(MAGIC + chunk_of(b"", bomb, claimed=1000) * 200 + END)
    assert "unpacks to more than 1000 bytes" in bounded("reader.info(here / 'a.mcap')", tmp_path)
    assert "nothing can be recovered" in bounded("repair.repair(here / 'a.mcap')", tmp_path)


def test_attachments_of_a_sparse_file(tmp_path):
    """Gigabytes of zeros that take no room on the disk."""
    size = 60 << 20
    with (tmp_path / "a.mcap").open("wb") as file:
        file.write(MAGIC)
        for i in range(16):
            head = struct.pack("<QQI1sI", 0, 0, 1, b"%x" % i, 0) + struct.pack("<Q", size)
            file.write(struct.pack("<BQ", 9, len(head) + size + 4) + head)
            file.seek(size + 4, os.SEEK_CUR)
        file.write(END)
    assert (tmp_path / "a.mcap").stat().st_blocks * 512 < 1 << 20
    for work in ("reader.info(here / 'a.mcap')", "repair.repair(here / 'a.mcap')"):
        assert "has attachments of more than 64 MiB together" in bounded(work, tmp_path)
    with (tmp_path / "a.mcap").open("r+b") as file:
        file.truncate(2 << 30)
    with pytest.raises(FileError, match="more than the 1,073,741,824"):
        info(tmp_path / "a.mcap")


def test_a_million_tiny_records(tmp_path):
    (tmp_path / "a.mcap").write_bytes(MAGIC + chunk_of(struct.pack("<BQ", 0x85, 0) * 500_000) * 3 + END)
    assert "has more than 1,000,000 records" in bounded("reader.info(here / 'a.mcap')", tmp_path)


@pytest.mark.parametrize(
    ("opcode", "length", "says"),
    [(3, 17 << 20, "schemas of"), (0x0C, 5 << 20, "metadata of"), (5, 9 << 20, "a message of")],
)
def test_kinds_of_records_have_limits_of_their_own(tmp_path, opcode, length, says):
    (tmp_path / "a.mcap").write_bytes(MAGIC + struct.pack("<BQ", opcode, length) + bytes(length) + END)
    with pytest.raises(LogError, match=says):
        info(tmp_path / "a.mcap")


def test_topics_without_end(tmp_path, monkeypatch):
    file = McapFile(tmp_path / "a.mcap")
    for i in range(401):
        file.add_channel(f"/{i}", 0)
    file.finish()
    with pytest.raises(LogError, match="has more than 400 topics"):
        info(tmp_path / "a.mcap")
    for name, value in (("MAX_RECORDS", 10), ("MAX_UNPACKED", 10)):
        monkeypatch.setattr(budget, name, value)
        with pytest.raises(LogError, match="no log of uuv eval"):
            info(tmp_path / "a.mcap")


def test_an_honest_log_is_far_from_every_limit(log_path, tmp_path):
    """Ten minutes of what the reference episode writes would still be read."""
    record = budget.LogBudget("x", log_path.stat().st_size)
    read = sum(1 for _ in read_messages(log_path))
    per_second = read / (N_STEP * episode.DT)
    assert per_second * 600 < budget.MAX_RECORDS
    assert record._unpacked_limit > 20 * log_path.stat().st_size
    assert info(log_path)["outcome"] == "success"


# ---------------------------------------------------------------------------------------------- wrong lengths


@pytest.mark.parametrize("bit", [0, 7, 16, 20, 40, 63])
@pytest.mark.parametrize("field", [1, 45])
def test_one_wrong_bit_in_a_length_of_a_chunk(log_path, tmp_path, bit, field):
    """The length of the record or that of its data: at most this chunk is lost, and nothing twice."""
    whole, places = bytearray(log_path.read_bytes()), chunks(log_path)
    assert len(places) > 3
    hit = places[1]
    whole[hit[0] + field + bit // 8] ^= 1 << bit % 8
    (tmp_path / "a.mcap").write_bytes(whole)
    before = [(m.topic, m.time_s) for m in read_messages(log_path)]
    if field == 45 and bit in (
        20,
        40,
    ):  # beyond the record, which ends where it should: the checksum says that nothing is missing
        assert [(m.topic, m.time_s) for m in read_messages(tmp_path / "a.mcap")] == before
        return
    with pytest.raises(LogError, match="uuv log repair"):
        info(tmp_path / "a.mcap")
    saved = repair(tmp_path / "a.mcap")
    assert saved.damages and not saved.complete
    after = [(m.topic, m.time_s) for m in read_messages(saved.path)]
    assert len(after) >= len(before) * (1 - 2 / len(places)) and sorted(set(after)) == sorted(after)
    assert set(after) <= set(before)
    if field == 1:
        assert after == before, "the data says how long it is"
    assert info(saved.path)["outcome"] == "success"


def test_a_wrong_length_of_another_record_costs_nothing_behind_it(log_path, tmp_path):
    """The index behind the first chunk claims to be longer: chunks are found again."""
    whole, places = bytearray(log_path.read_bytes()), chunks(log_path)
    behind = places[0][0] + 9 + places[0][1]
    whole[behind + 1 : behind + 9] = struct.pack("<Q", places[1][0] - behind + 500)
    (tmp_path / "a.mcap").write_bytes(whole)
    before, after = (
        [(m.topic, m.time_s) for m in read_messages(path)]
        for path in (log_path, repair(tmp_path / "a.mcap").path)
    )
    assert sorted(set(after)) == sorted(set(before))


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
    monkeypatch.setattr("uuvtai.logs.log_export.MAX_ARRAYS", 100_000)
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
        "video": lambda path: video(path, tmp_path / "x.webm"),
        "convert": lambda path: from_rosbag2(path, tmp_path / "x.mcap"),
        "repair": repair,
        "export": lambda path: export(path, tmp_path / "x"),
    }
    for path in (tmp_path / "a.mcap", Path("/dev/zero")):
        with pytest.raises(FileError, match=r"is a (pipe|device)"):
            works[command](path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap"]


# ---------------------------------------------------------------------------------------------------- outputs


@pytest.mark.parametrize("command", ["picture", "video", "convert", "repair"])
def test_no_output_is_the_input_or_replaces_a_file(log_path, tmp_path, command, capfd):
    mine, log = tmp_path / "mine", tmp_path / "a.mcap"
    mine.write_text("precious")
    log.write_bytes(log_path.read_bytes())
    (tmp_path / "link.mcap").symlink_to(log)
    (tmp_path / "dangling").symlink_to(tmp_path / "nothing")
    for out in (log, tmp_path / "link.mcap", mine, tmp_path / "dangling", tmp_path / "sub" / ".." / "a.mcap"):
        assert run_cli("log", command, log, "--out", out) == 2
    for out in (log, tmp_path / "link.mcap", tmp_path / "dangling"):
        assert run_cli("log", command, log, "--out", out, "--force") == 2
    said = capfd.readouterr().err
    assert (
        said.count("is already there") >= 1
        and said.count("is what is read here") >= 4
        and "Traceback" not in said
    )
    assert (
        mine.read_text() == "precious"
        and log.read_bytes() == log_path.read_bytes()
        and not (tmp_path / "nothing").exists()
    )


def test_a_log_cannot_plant_files_in_a_folder_that_is_there(tmp_path, capfd):
    file = McapFile(tmp_path / "a.mcap")
    names = [
        "conftest.py",
        "Makefile",
        "../conftest.py",
        "CON",
        "nul.txt",
        "a",
        "A",
        "-rf",
        "x.",
        "metadata.json",
    ]
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
    assert [path.name for path in project.iterdir()] == ["conftest.py"] and (
        project / "conftest.py"
    ).read_text() == "mine"
    (tmp_path / "link").symlink_to(tmp_path)
    assert run_cli("log", "export", tmp_path / "a.mcap", "--out", tmp_path / "link") == 2
    (tmp_path / "new").mkdir()
    assert run_cli("log", "export", tmp_path / "a.mcap", "--out", tmp_path / "new", "--format", "csv") == 0
    kept = sorted(path.name for path in (tmp_path / "new" / "attachments").iterdir())
    assert len({name.casefold() for name in kept}) == len(names)
    assert not {"CON", "nul.txt"} & set(kept) and not any(
        name.startswith("-") or name.endswith(".") for name in kept
    )
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
    "doubled thirty times": (
        [("Concat", [f"x{i}"] * 2, [f"x{i + 1}"], {"axis": 1}) for i in range(30)],
        [("x0", np.ones((1, 1), "f4"))],
        "more than 256 MiB",
    ),
    "a column by a row": (
        [("Transpose", ["w"], ["t"]), ("Mul", ["w", "t"], ["x"])],
        [("w", np.ones((9999, 1), "f4"))],
        "more than 256 MiB",
    ),
    "long work": (
        [("MatMul", ["w" if i == 0 else f"x{i}", "w"], [f"x{i + 1}"]) for i in range(40)],
        [("w", np.ones((400, 400), "f4"))],
        "multiplications",
    ),
    **{
        f"operator {name}": ([(name, ["obs"], ["x"])], [], f"has onnx.{name}")
        for name in (
            "Expand",
            "Tile",
            "Range",
            "Resize",
            "RandomNormalLike",
            "NonZero",
            "Loop",
            "If",
            "Scan",
            "Pad",
            "OneHot",
            "Einsum",
        )
    },
}


@pytest.mark.parametrize(("nodes", "weights", "says"), STRANGE.values(), ids=STRANGE)
def test_graphs_that_take_memory_or_time_never_reach_onnx_runtime(nodes, weights, says, monkeypatch):
    monkeypatch.setattr(
        "uuvtai.deploy.onnx_session.session", lambda _graph: pytest.fail("ONNX Runtime saw it")
    )
    graph = graph_of(nodes, weights)
    with pytest.raises(GraphError, match=says):
        of_onnx(
            graph,
            {
                f"pair_{name}": np.zeros(shape, bool if name == "has_last" else np.float32)
                for name, shape in INPUTS.items()
            },
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
    with pytest.raises(GraphError, match="has opset onnx 9"):
        refuse_strange(graph_of(add, opset=9), INPUTS, 1)
    with pytest.raises(GraphError, match="takes has_last"):
        refuse_strange(graph_of(add), {"obs": (64, 40)}, 1)
    assert not {"Loop", "If", "Scan", "Expand", "Tile", "Range", "Resize", "NonZero"} & graph_check.OPERATORS
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
@pytest.mark.parametrize("name", ["policy_spec.json", "policy.safetensors", "golden.npz", "README.md"])
def test_a_pipe_in_an_exported_folder_is_not_waited_for(folder, name):
    (folder / name).unlink()
    os.mkfifo(folder / name)
    done = subprocess.run(
        [sys.executable, folder / "run_policy.py"], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 1 and "no plain file" in done.stderr and "Traceback" not in done.stderr


def golden_with(folder, **arrays):
    golden = run_policy.read_golden(folder / "golden.npz") | arrays
    np.savez(folder / "golden.npz", **golden)
    deployed.resigned(folder, "golden.npz", (folder / "golden.npz").read_bytes())


@pytest.mark.parametrize(
    "arrays",
    [
        {"value": np.float32(1)},
        {"obs": np.float32(1)},
        {"begins": np.float32(1)},
        {"obs": np.zeros((0, 40), np.float32), "begins": np.zeros(0, bool)},
        {"obs": np.zeros((5, 3), np.float32)},
        {"obs": np.array(["x"] * 40)},
        {"action": np.array("word")},
        {"obs": np.zeros((70_000, 40), np.float32), "begins": np.zeros(70_000, bool)},
    ],
    ids=str,
)
def test_golden_pairs_of_other_shapes_are_one_line(folder, arrays, capfd):
    golden_with(folder, **arrays)
    assert run_policy.main([str(folder)]) in (1, 3)
    assert "Traceback" not in capfd.readouterr().err
    assert run_cli("export", "--check", folder) in (2, 3)
    assert "Traceback" not in capfd.readouterr().err


def test_only_an_exported_policy_is_replaced(folder, tmp_path, monkeypatch):
    monkeypatch.setattr(deployed.deploy, "missing_packages", lambda: ["onnx"])
    found = deployed.saved(tmp_path / "run")
    (folder / "policy_spec.json").write_text("{}")
    assert deployed.deploy.export(found, "mine", folder, (), lambda _text: None, force=True).agrees
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
