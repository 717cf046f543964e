"""Weights: PyTorch checkpoints read without running them, the library's own files, Orbax checkpoints."""

import collections
import hashlib
import io
import json
import os
import pickle
import shutil
import sys
import zipfile
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from torch_files import Named, Writer, pickled, tensor, write

from jaxtrapolate import weights
from jaxtrapolate.errors import InputError
from jaxtrapolate.methods.extranet import load_extranet
from jaxtrapolate.weights.pickled import read_pickle
from jaxtrapolate.weights.tree import nested


@pytest.mark.parametrize(
    ("kind", "dtype"),
    [
        ("DoubleStorage", np.float64),
        ("FloatStorage", np.float32),
        ("HalfStorage", np.float16),
        ("BFloat16Storage", jnp.bfloat16),
        ("LongStorage", np.int64),
        ("IntStorage", np.int32),
        ("ShortStorage", np.int16),
        ("CharStorage", np.int8),
        ("ByteStorage", np.uint8),
        ("BoolStorage", np.bool_),
    ],
)
def test_every_dtype(tmp_path, kind, dtype):
    values = np.array([1, 0, 3, 5, 0, 7]).astype(dtype)
    path = write(tmp_path / "a.pth", {"a": tensor(kind, "0", 6, 0, (2, 3), (3, 1))}, {"0": values.tobytes()})
    found = weights.read_torch(path)["a"]
    assert found.dtype == values.dtype
    assert np.array_equal(found, values.reshape(2, 3))


def test_views_of_one_storage(tmp_path):
    """Transposed, with an offset, every second value, a scalar, an empty one, and shared."""
    values = np.arange(24, dtype=np.float32)
    state = collections.OrderedDict(
        whole=tensor("FloatStorage", "7", 24, 0, (2, 3, 4), (12, 4, 1)),
        transposed=tensor("FloatStorage", "7", 24, 0, (4, 3, 2), (1, 4, 12)),
        part=tensor("FloatStorage", "7", 24, 5, (3, 2), (6, 2)),
        scalar=tensor("FloatStorage", "7", 24, 23, (), ()),
        empty=tensor("FloatStorage", "7", 24, 24, (0, 5), (5, 1)),
        older=tensor("FloatStorage", "7", 24, 0, (24,), (1,), "_rebuild_tensor"),
        parameter=Named("torch._utils", "_rebuild_parameter", tensor("FloatStorage", "7", 24, 1, (2,), (1,)), True, ()),
    )
    content = {"epoch": 3, "state_dict": state, "rates": [1e-3, None, True, ("a", "b")]}
    found = weights.read_torch(write(tmp_path / "a.pth.tar", content, {"7": values.tobytes()}))
    assert found["epoch"] == 3
    assert found["rates"] == [1e-3, None, True, ("a", "b")]
    state = found["state_dict"]
    assert type(state) is dict
    assert np.array_equal(state["whole"], values.reshape(2, 3, 4))
    assert np.array_equal(state["transposed"], values.reshape(2, 3, 4).transpose(2, 1, 0))
    assert np.array_equal(state["part"], [[5, 7], [11, 13], [17, 19]])
    assert state["scalar"].shape == ()
    assert state["scalar"] == 23
    assert state["empty"].shape == (0, 5)
    assert np.array_equal(state["older"], values)
    assert np.array_equal(state["parameter"], [1, 2])
    assert not state["whole"].flags.writeable


def test_byte_order_and_attributes(tmp_path):
    """A checkpoint of a big-endian machine; a state_dict with the attribute that PyTorch sets."""
    state = collections.OrderedDict(a=tensor("FloatStorage", "0", 2, 0, (2,), (1,)))
    state._metadata = collections.OrderedDict({"": {"version": 1}})
    content = pickled(state)
    assert b"b." in content[-3:]  # BUILD
    big = np.array([1.5, -2.0], ">f4").tobytes()
    path = write(tmp_path / "a.pth", content, {"0": big}, root="net", more=[("byteorder", b"big")])
    assert np.array_equal(weights.read_torch(path)["a"], np.float32([1.5, -2.0]))


@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
def test_every_protocol_of_plain_data(protocol):
    value = {"a": [1, 2.5, -(2**70), None, True], "b": {"c": ("x" * 300, ())}, 3: [[]], "d": 300, "e": -70000}
    value |= {"f": (1, 2), "g": (1, 2, 3), "h": (1, 2, 3, 4)}
    value |= {"i": [b"y", b"y" * 300]} if protocol > 2 else {}  # 2 has no bytes
    value["again"] = value["a"]
    found = read_pickle(pickle.dumps(value, protocol), calls={}, expected="data")
    assert found == value
    assert found["again"] is found["a"]


class Reduces:
    def __init__(self, *parts):
        self.parts = parts

    def __reduce__(self):
        return self.parts


MALICE = {
    "os.system": (Reduces(os.system, ("exit 1",)), r"names (posix|nt)\.system, where only tensors are expected"),
    "eval": (Reduces(eval, ("1",)), r"names (builtins|__builtin__)\.eval"),
    "getattr": (Reduces(getattr, (collections.OrderedDict, "__init__")), r"names (builtins|__builtin__)\.getattr"),
    "importlib": (Reduces(__import__, ("os",)), r"names (builtins|__builtin__)\.__import__"),
    "subclass": (collections.Counter("a"), r"names collections\.Counter"),
    "numpy": (np.zeros(2), r"names numpy\._core\.multiarray\._reconstruct"),
    "torch.load": (Named("torch", "load", "x"), r"names torch\.load"),
    "torch.storage": (Named("torch.storage", "_load_from_bytes", b"x"), r"names torch\.storage\._load_from_bytes"),
    "dotted": (Named("collections", "OrderedDict.fromkeys", [1]), r"names collections\.OrderedDict\.fromkeys"),
    "spaces": (Named("os", "\tsystem\x0b", ""), r"names os\. system, where"),
    "long name": (Named("a" * 9999, "b"), r"names a{100}, where"),
    "a dtype called": (Named("torch", "FloatStorage", 5), r"calls torch\.FloatStorage"),
    "arguments": (Named("collections", "OrderedDict", [("a", 1)]), r"damaged pickle \(TypeError"),
    "set": ({1, 2}, r"names (builtins|__builtin__)\.set"),
    "tuple as key": ({(1, 2): 3}, r"has a tuple as a key"),
    "tensor of a list": (Named("torch._utils", "_rebuild_tensor_v2", [1.0], 0, (1,), (1,)), "storage is a list"),
    "parameter of text": (Named("torch._utils", "_rebuild_parameter", "a", True, ()), "parameter is a str"),
    "list": ([1, 2], r"expected a dictionary, got list"),
}


@pytest.mark.parametrize("case", sorted(MALICE))
def test_nothing_else_is_read(tmp_path, case):
    value, message = MALICE[case]
    path = write(tmp_path / "a.pth.tar", value if case == "list" else {"a": value})
    with pytest.raises(ValueError, match=message) as caught:
        weights.read_torch(path)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith(str(path))
    assert len(text) < len(str(path)) + 200


@pytest.mark.parametrize("protocol", [2, 4])
def test_globals_by_every_opcode(protocol):
    """GLOBAL and STACK_GLOBAL; NEWOBJ, INST and OBJ make objects, EXT and BUFFER lead elsewhere: refused by name."""
    for code, message in (
        (pickle.dumps(os.system, protocol), r"names (posix|nt)\.system"),
        (b"\x80\x02cposix\nsystem\n)\x81.", r"names posix\.system"),
        (b"(S'x'\niposix\nsystem\n.", "opcode STRING"),
        (b"(iposix\nsystem\n.", "opcode INST"),
        (b"(ccollections\nOrderedDict\no.", "opcode OBJ"),
        (b"ccollections\nOrderedDict\n)\x81.", "opcode NEWOBJ"),
        (b"\x82\x01.", "opcode EXT1"),
        (b"\x8f.", "opcode EMPTY_SET"),
        (b"P0\n.", "opcode PERSID"),
        (b"Np0\n}b.", "sets the state of a NoneType"),
        (b"ccollections\nOrderedDict\n}b.", "sets the state of a Global"),
    ):
        with pytest.raises(ValueError, match=message):
            read_pickle(code, calls={"collections.OrderedDict": lambda: {}}, expected="data")


def test_a_machine_that_is_out_of_step():
    for code, message in (
        (b".", "nothing on the stack"),
        (b"0.", "nothing on the stack"),
        (b"]](0.", "nothing on the stack"),  # nothing above the mark
        (b"t.", "no mark"),
        (b"(Nu.", "nothing on the stack"),
        (b"}(Nu.", "a key without a value"),
        (b"}Na.", "a dict in the place of a list"),
        (b"]NNs.", "a list in the place of a dict"),
        (b"NNR.", "a NoneType in the place of a tuple"),
        (b"N)R.", "a NoneType in the place of a Global"),
        (b"h\x05.", "KeyError"),
        (b"N", "exhausted"),
        (b"", "exhausted"),
        (b"X\xff\xff\xff\x7fabc.", "expected"),
        (b"\xff.", "unknown"),
        (b"NN\x93.", "a NoneType in the place of a str"),
    ):
        with pytest.raises(ValueError, match=message):
            read_pickle(code, calls={}, expected="data")


def test_a_large_memo_and_deep_nesting_take_no_memory():
    """What makes pickle.Unpickler ask for 16 GB, and what would overflow a stack."""
    assert read_pickle(b"Nr\xff\xff\xff\x7f.", calls={}, expected="data") is None
    depth = 20_000
    found = read_pickle(b"]" * depth + b"a" * (depth - 1) + b".", calls={}, expected="data")
    for _ in range(depth - 1):
        (found,) = found
    assert found == []
    assert sys.getrecursionlimit() < depth


CLAIMS = {
    "count": (tensor("FloatStorage", "0", 2**40, 0, (2**40,), (1,)), "claims 1099511627776 of float32, holds 16 bytes"),
    "dtype": (tensor("DoubleStorage", "0", 4, 0, (4,), (1,)), "claims 4 of float64, holds 16 bytes"),
    "shape": (tensor("FloatStorage", "0", 4, 0, (2**30,), (0,)), "exceeds its 4"),
    "repeated": (tensor("FloatStorage", "0", 4, 0, (5,), (0,)), "exceeds its 4"),
    "beyond": (tensor("FloatStorage", "0", 4, 1, (4,), (1,)), "offset 1 exceeds its 4"),
    "strides": (tensor("FloatStorage", "0", 4, 0, (2, 2), (3, 1)), "exceeds its 4"),
    "offset": (tensor("FloatStorage", "0", 4, 4, (), ()), "exceeds its 4"),
    "negative offset": (tensor("FloatStorage", "0", 4, -1, (1,), (1,)), "offset is no tuple of sizes"),
    "negative stride": (tensor("FloatStorage", "0", 4, 3, (4,), (-1,)), "strides is no tuple of sizes"),
    "negative count": (tensor("FloatStorage", "0", -4, 0, (1,), (1,)), "claims -4"),
    "huge": (tensor("FloatStorage", "0", 4, 0, (2**70,), (1,)), "shape is no tuple of sizes"),
    "empty but huge": (tensor("FloatStorage", "0", 4, 0, (0, 2**47, 2**47), (1, 1, 1)), "array is too big|exceeds"),
    "a float": (tensor("FloatStorage", "0", 4, 0, (1.0,), (1,)), "shape is no tuple of sizes"),
    "true": (tensor("FloatStorage", "0", 4, True, (1,), (1,)), "offset is no tuple of sizes"),
    "dimensions": (tensor("FloatStorage", "0", 4, 0, (1,) * 33, (1,) * 33), "shape is no tuple of sizes"),
    "other strides": (tensor("FloatStorage", "0", 4, 0, (1, 1), (1,)), r"shape \[1, 1\] and the strides \[1\]"),
    "no storage": (tensor("FloatStorage", "1", 4, 0, (4,), (1,)), "no item named"),
    "kind of storage": (tensor("UntypedStorage", "0", 4, 0, (4,), (1,)), r"names torch\.UntypedStorage"),
}


@pytest.mark.parametrize("case", sorted(CLAIMS))
def test_claims_are_held_against_what_is_there(tmp_path, case):
    value, message = CLAIMS[case]
    path = write(tmp_path / "a.pth", {"a": value}, {"0": np.zeros(4, np.float32).tobytes()})
    with pytest.raises(ValueError, match=message):
        weights.read_torch(path)


def test_other_references_are_refused(tmp_path):
    class Elsewhere(Writer):
        def persistent_id(self, value):
            return ("module", "os", "system") if value == "there" else None

    buffer = io.BytesIO()
    Elsewhere(buffer, 2).dump({"a": "there"})
    with pytest.raises(ValueError, match="that is no storage"):
        weights.read_torch(write(tmp_path / "a.pth", buffer.getvalue()))


def test_compressed_members_are_refused(tmp_path):
    """A megabyte of zeros in a kilobyte: PyTorch stores its members as they are."""
    bomb = {"a": tensor("FloatStorage", "0", 2**18, 0, (2**18,), (1,))}
    path = write(tmp_path / "a.pth", bomb, {"0": bytes(2**20)}, compression=zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 10_000
    with pytest.raises(ValueError, match="compressed"):
        weights.read_torch(path)


def test_members_that_overlap_are_refused(tmp_path):
    """A directory in which every storage is the same bytes of the file."""
    path = write(
        tmp_path / "a.pth",
        [tensor("FloatStorage", str(i), 250, 0, (250,), (1,)) for i in range(9)],
        {str(i): bytes(1000) for i in range(9)},
    )
    content = path.read_bytes()
    with zipfile.ZipFile(path) as archive:
        offsets = {i.filename: i.header_offset for i in archive.infolist()}
    directory = content.index(b"PK\x01\x02")
    content, first = bytearray(content), offsets["archive/data/0"]
    for i in range(1, 9):
        at = content.index(f"archive/data/{i}".encode(), directory) - 46
        content[at + 42 : at + 46] = first.to_bytes(4, "little")
    path.write_bytes(content[: offsets["archive/data/1"]] + content[directory:])
    with pytest.raises(ValueError, match=r"a\.pth"):
        weights.read_torch(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a PyTorch checkpoint: no zip file"),
        (pickle.dumps({"state_dict": 1}), "saved by a newer one|saved again"),
        (b"PK\x03\x04" + bytes(100), "not a PyTorch checkpoint"),
    ],
)
def test_other_files_are_no_checkpoints(tmp_path, content, message):
    path = tmp_path / "a.pth.tar"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=message):
        weights.read_torch(path)
    with pytest.raises(FileNotFoundError):
        weights.read_torch(tmp_path / "b.pth.tar")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("readme", "hello")
    with pytest.raises(ValueError, match=r"no data\.pkl"):
        weights.read_torch(path)


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory):
    values = np.arange(60, dtype=np.float32)
    state = {f"layer{i}.weight": tensor("FloatStorage", str(i), 60, 0, (3, 4, 5), (20, 5, 1)) for i in range(3)}
    path = tmp_path_factory.mktemp("checkpoint") / "a.pth.tar"
    return write(path, {"epoch": 1, "state_dict": state}, {str(i): values.tobytes() for i in range(3)})


def _read_or_refuse(path, content):
    """Whatever the file is: the arrays, or one line."""
    path.write_bytes(content)
    refused = None
    try:
        found = weights.read_torch(path)
    except ValueError as error:
        found, refused = None, str(error)
    if refused is not None:
        assert "\n" not in refused
        assert refused.startswith(str(path))
    return found


@settings(max_examples=150, deadline=None)
@given(st.data())
def test_truncated_and_changed_files_end_in_one_line(checkpoint, data):
    whole = checkpoint.read_bytes()
    path = checkpoint.with_name("b.pth.tar")
    cut = data.draw(st.integers(0, len(whole) - 1))
    assert _read_or_refuse(path, whole[:cut]) is None
    changed = bytearray(whole)
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, len(whole) - 1), st.integers(0, 255)), max_size=4)):
        changed[place] = value
    _read_or_refuse(path, bytes(changed))
    with zipfile.ZipFile(checkpoint) as archive:
        code = bytearray(archive.read("archive/data.pkl"))
    for place, value in data.draw(st.lists(st.tuples(st.integers(0, len(code) - 1), st.integers(0, 255)), max_size=4)):
        code[place] = value
    storages = {str(i): bytes(240) for i in range(3)}
    _read_or_refuse(path, write(path, bytes(code), storages).read_bytes())
    assert _read_or_refuse(path, write(path, bytes(code)[: cut % len(code)], storages).read_bytes()) is None


def test_the_official_checkpoint(data):
    found = weights.read_torch(data / "extranet_medieval.pth.tar")
    assert set(found) == {"epoch", "state_dict", "optimizer"}
    assert found["epoch"] == 211
    state = found["state_dict"]
    parameters = [v for k, v in state.items() if not k.endswith(("running_mean", "running_var", "num_batches_tracked"))]
    assert sum(v.size for v in parameters) == 262_141
    assert state["convHis1.0.weight"].shape == (24, 4, 3, 3)
    assert all(np.isfinite(v).all() for v in state.values())
    assert (state["bn1.running_var"] > 0).all()
    assert found["optimizer"]["param_groups"][0]["betas"] == (0.9, 0.999)


# Trees


def tree():
    rng = np.random.default_rng(3)
    return {
        "encoder": [{"kernel": rng.normal(size=(3, 3, 2, 4)).astype(np.float32), "bias": np.zeros(4, np.float32)}],
        "count": np.int32(7),
        "half": np.float16([1, 2]),
    }


def test_fit_names_what_is_wrong():
    template = tree()
    given = {"encoder": {"0": dict(template["encoder"][0])}, "count": np.int32(7), "half": np.float16([1, 2])}
    fitted = weights.fit(template, given, source="a.npz")
    assert jax.tree.structure(fitted) == jax.tree.structure(template)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(fitted), jax.tree.leaves(template), strict=True))
    given["encoder"]["0"]["bias"] = np.zeros(5)
    del given["half"]
    given["other"] = np.zeros(1)
    message = r"a\.npz: .*missing half; nothing takes other; encoder/0/bias is \[5\], expected \[4\]"
    with pytest.raises(ValueError, match=message):
        weights.fit(template, given, source="a.npz")
    many = {f"layer{i}": np.zeros(1) for i in range(9)}
    with pytest.raises(ValueError, match="missing layer0, layer1, layer2, layer3 and 5 more"):
        weights.fit(many, {}, source="a.npz")


def test_fit_takes_shapes_alone():
    template = jax.eval_shape(lambda: jax.tree.map(jnp.asarray, tree()))
    fitted = weights.fit(template, tree(), source="a.npz")
    assert fitted["half"].dtype == jnp.float16
    assert isinstance(fitted["half"], jax.Array)


def test_names_must_be_paths():
    with pytest.raises(ValueError, match="is in the path of"):
        nested({"a": np.zeros(1), "a/b": np.zeros(1)})
    with pytest.raises(ValueError, match="is in the path of"):
        nested({"a/b": np.zeros(1), "a": np.zeros(1)})


def test_fingerprints_tell_weights_apart():
    first, second = tree(), tree()
    assert weights.fingerprint(first) == weights.fingerprint(second)
    second["encoder"][0]["kernel"][0, 0, 0, 0] += 1
    third = {**tree(), "half": np.float16([[1, 2]])}
    assert len({weights.fingerprint(t) for t in (first, second, third)}) == 3


# The library's own files


def save(folder, value=None, **kwargs):
    given = {"config": {"width": 24, "nested": {"a": [1, 2.5, None]}}, "note": "trained on nothing", **kwargs}
    return weights.save_weights(folder, "extranet", tree() if value is None else value, **given)


def test_round_trip(tmp_path):
    path = save(tmp_path)
    assert path.name == f"extranet-{hashlib.sha256(path.read_bytes()).hexdigest()[:8]}.npz"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    found = weights.load_weights(path)
    assert (found.method, found.note, found.source) == ("extranet", "trained on nothing", str(path))
    assert found.config == {"width": 24, "nested": {"a": [1, 2.5, None]}}
    fitted = weights.fit(tree(), found.tree, source=found.source)
    for before, after in zip(jax.tree.leaves(tree()), jax.tree.leaves(fitted), strict=True):
        assert after.dtype == before.dtype
        assert np.array_equal(after, before)


def test_the_file_is_an_ordinary_npz(tmp_path):
    with np.load(save(tmp_path)) as arrays:
        assert set(arrays.files) == {"encoder/0/kernel", "encoder/0/bias", "count", "half", "__metadata__"}
        assert np.array_equal(arrays["encoder/0/kernel"], tree()["encoder"][0]["kernel"])
        assert json.loads(arrays["__metadata__"].item())["method"] == "extranet"


def test_bytes_are_the_same_however_arrays_lie(tmp_path):
    first = save(tmp_path)
    other = {key: tree()[key] for key in ("half", "encoder", "count")}
    other["encoder"][0] = {k: np.asfortranarray(other["encoder"][0][k]).astype(">f4") for k in ("bias", "kernel")}
    second = save(tmp_path, jax.tree.map(lambda a: a, other), name="again")
    assert second.read_bytes() == first.read_bytes()
    assert second.name == first.name.replace("extranet", "again")
    assert first.name == "extranet-6d14e736.npz"  # the same on every machine


def test_damage_is_noticed(tmp_path):
    path = save(tmp_path)
    content = bytearray(path.read_bytes())
    content[200] ^= 1
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"extranet-\w+\.npz: damaged or changed: its hash is"):
        weights.load_weights(path)
    plain = tmp_path / "extranet.npz"
    plain.write_bytes(content)
    with pytest.raises(ValueError, match="name that ends in the file's hash"):
        weights.load_weights(plain)
    for absent in ("extranet-00000000.npz", "model"):
        with pytest.raises(FileNotFoundError):
            weights.load_weights(tmp_path / absent)


def test_files_may_be_larger_than_those_of_the_package(tmp_path):
    """2 MB is what the package's own may take, and no bound for networks of others."""
    tree = {"a": np.arange(600_000, dtype=np.float32)}
    path = save(tmp_path, tree)
    assert path.stat().st_size > weights.files.LARGEST_SHIPPED
    np.testing.assert_array_equal(weights.load_weights(path).tree["a"], tree["a"])
    for shipped in Path(weights.__file__).parent.glob("*.npz"):
        assert shipped.stat().st_size <= weights.files.LARGEST_SHIPPED


def test_what_no_file_may_hold(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(weights.files, "LARGEST", 1000)
        with pytest.raises(ValueError, match=r"expected at most 1000"):
            save(tmp_path, {"a": np.zeros(500, np.float32)})
    with pytest.raises(ValueError, match=r"a is of object"):
        save(tmp_path, {"a": np.array([None])})
    with pytest.raises(ValueError, match=r"b is of bfloat16"):
        save(tmp_path, {"b": jnp.zeros(2, jnp.bfloat16)})
    with pytest.raises(ValueError, match="two arrays have the name 'a/b'"):
        save(tmp_path, {"a/b": np.zeros(1), "a": {"b": np.zeros(1)}})
    with pytest.raises(ValueError, match="expected one line, got 2"):
        save(tmp_path, note="a\nb")
    with pytest.raises(InputError, match="its folder does not exist"):
        save(tmp_path / "none")
    assert list(tmp_path.iterdir()) == []


def _named_by_hash(folder, content):
    path = folder / f"extranet-{hashlib.sha256(content).hexdigest()[:8]}.npz"
    path.write_bytes(content)
    return path


def _npz(members, compression=zipfile.ZIP_STORED):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def _npy(array, pickles=False):
    buffer = io.BytesIO()
    np.lib.format.write_array(buffer, array, (1, 0), allow_pickle=pickles)
    return buffer.getvalue()


def test_a_right_hash_does_not_make_weights(tmp_path, monkeypatch):
    metadata = _npy(np.array(json.dumps({"method": "extranet", "config": {}, "note": ""}).encode()))
    huge = _npy(np.zeros(4, np.float32)).replace(b"(4,)", b"(9999999999999,)").replace(b" " * 13 + b"\n", b"\n")
    for content, message in (
        (b"hello", "no weights of this library"),
        (_npz({"a.npy": _npy(np.zeros(2))}), "__metadata__"),
        (_npz({"__metadata__.npy": _npy(np.array(b"{}"))}), "state no config"),
        (_npz({"__metadata__.npy": _npy(np.array(b"[]"))}), "state no method"),
        (_npz({"__metadata__.npy": metadata, "a.npy": b"junk"}), "no weights of this library"),
        (_npz({"__metadata__.npy": metadata, "a.npy": huge}), "no weights of this library"),
        (_npz({"__metadata__.npy": metadata, "a.npy": _npy(np.zeros(2))}, zipfile.ZIP_DEFLATED), "is compressed"),
        (_npz({"__metadata__.npy": metadata, "a.npy": _npy(np.array([{}]), pickles=True)}), "holds no numbers"),
        (_npz({"__metadata__.npy": metadata, "a.npy": _npy(np.zeros(2)), "a/b.npy": _npy(np.zeros(2))}), "in the path"),
    ):
        with pytest.raises(ValueError, match=message) as caught:
            weights.load_weights(_named_by_hash(tmp_path, content))
        assert "\n" not in str(caught.value)
    monkeypatch.setattr(weights.files, "LARGEST", 1000)
    with pytest.raises(ValueError, match="expected at most 1000"):
        weights.load_weights(_named_by_hash(tmp_path, bytes(1001)))


def test_default_weights(tmp_path, monkeypatch):
    from jaxtrapolate.weights import files

    monkeypatch.setattr(files, "_SHIPPED", tmp_path)
    with pytest.raises(ValueError, match="method 'extranet': no default weights come with this version"):
        weights.default_weights("extranet")
    path = save(tmp_path)
    save(tmp_path, name="extranet-small")
    assert weights.default_weights("extranet") == path
    save(tmp_path, {"a": np.zeros(1)})
    with pytest.raises(ValueError, match="several default weights"):
        weights.default_weights("extranet")


def _npz_file(folder, members):
    """A file of weights with the right hash, whose members are these bytes."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    path = folder / f"a-{hashlib.sha256(buffer.getvalue()).hexdigest()[:8]}.npz"
    path.write_bytes(buffer.getvalue())
    return path


def _array(header):
    return b"\x93NUMPY\x01\0" + len(header).to_bytes(2, "little") + header


HEADERS = {
    "brackets": b"{'descr': " + b"(" * 300 + b")" * 300 + b"}\n",
    "no end": b"{'descr': \"\"\"<f4, 'shape': (3,\n",
    "zeros": bytes(100),
    "number": b"{'descr': '<f4', 'fortran_order': False, 'shape': (" + b"9" * 5000 + b",)}\n",
    "large": b"{'descr': '<f4', 'fortran_order': False, 'shape': (4000000000000,)}\n",
}


@pytest.mark.parametrize("case", sorted(HEADERS))
def test_damaged_headers_of_arrays(tmp_path, case):
    path = _npz_file(tmp_path, {"a.npy": _array(HEADERS[case])})
    with pytest.raises(ValueError, match="no weights of this library") as error:
        weights.load_weights(path)
    assert str(error.value).startswith(str(path))
    assert "\n" not in str(error.value)


def test_nested_metadata(tmp_path):
    text = b'{"method": "a", "note": "", "config": ' + b'{"a":' * 100_000 + b"1" + b"}" * 100_000 + b"}"
    header = f"{{'descr': '|S{len(text)}', 'fortran_order': False, 'shape': ()}}\n".encode()
    path = _npz_file(tmp_path, {"__metadata__.npy": _array(header) + text})
    with pytest.raises(ValueError, match="no weights of this library"):
        weights.load_weights(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
@pytest.mark.parametrize("name", ["a-12345678.npz", "a.pth.tar"])
def test_only_regular_files_are_weights(tmp_path, name):
    read = weights.load_weights if name.endswith("npz") else weights.read_torch
    os.mkfifo(tmp_path / name)
    with pytest.raises(OSError, match="is a named pipe, not a regular file"):
        read(tmp_path / name)
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to("/dev/zero")
    with pytest.raises(OSError, match="is a device, not a regular file"):
        read(tmp_path / name)
    (tmp_path / name).unlink()
    (tmp_path / name).symlink_to(name)
    with pytest.raises(OSError, match="symbolic links"):
        read(tmp_path / name)


def test_lines_about_names_that_are_no_utf8(tmp_path):
    path = os.path.join(tmp_path, os.fsdecode(b"caf\xe9\n-12345678.npz"))
    with open(path, "wb") as file:
        file.write(b"nothing")
    for read in (weights.load_weights, weights.read_torch):
        with pytest.raises(ValueError, match=r"caf\\udce9\\n-12345678\.npz: ") as error:
            read(path)
        str(error.value).encode("utf-8")
        assert "\n" not in str(error.value)


@pytest.mark.parametrize("state", [[], {1: 2}, {"a": 3}, None, {"a": [1]}])
def test_a_state_dict_that_is_none(tmp_path, state):
    path = write(tmp_path / "a.pth.tar", {"state_dict": state})
    with pytest.raises(ValueError, match=r"a\.pth\.tar: no weights of ExtraNet: .*(no table of arrays|is no array)"):
        load_extranet(path)


# Orbax


@pytest.fixture(scope="module")
def orbax(tmp_path_factory):
    import orbax.checkpoint as ocp

    folder = tmp_path_factory.mktemp("orbax")
    arrays = jax.tree.map(jnp.asarray, tree())
    with ocp.StandardCheckpointer() as checkpointer:
        checkpointer.save(folder / "plain", arrays)
    with ocp.CheckpointManager(folder / "managed") as manager:
        for step in (9, 10):
            scaled = jax.tree.map(lambda a, step=step: a * np.asarray(step, a.dtype), arrays)
            items = ocp.args.Composite(
                weights=ocp.args.StandardSave(scaled),
                metadata=ocp.args.JsonSave({"method": "extranet", "config": {"step": step}, "note": "a note"}),
                optimiser=ocp.args.StandardSave(arrays),
            )
            manager.save(step, args=items)
        manager.wait_until_finished()
    return folder


def test_orbax_checkpoints(orbax, caplog):
    found = weights.load_orbax(orbax / "plain")
    assert (found.method, found.config, found.note) == (None, {}, "")
    fitted = weights.fit(tree(), found.tree, source=found.source)
    assert all(np.array_equal(a, b) for a, b in zip(jax.tree.leaves(fitted), jax.tree.leaves(tree()), strict=True))
    for folder, step in ((orbax / "managed", 10), (orbax / "managed" / "9", 9)):
        found = weights.load_orbax(folder)
        assert (found.method, found.config, found.note) == ("extranet", {"step": step}, "a note")
        assert isinstance(found.tree["half"], np.ndarray)
        assert np.array_equal(found.tree["half"], np.float16([step, 2 * step]))
    assert not [r for r in caplog.records if r.levelname == "WARNING"]


def test_other_folders_are_no_checkpoints(orbax, tmp_path):
    for folder in (tmp_path, tmp_path / "none", orbax):
        with pytest.raises(ValueError, match=r"no Orbax checkpoint, or one without the item 'weights'"):
            weights.load_orbax(folder)
    (tmp_path / "_METADATA").write_text("{}")
    with pytest.raises(ValueError, match="damaged Orbax checkpoint"):
        weights.load_orbax(tmp_path)


def test_pipes_devices_and_circles_in_a_checkpoint(orbax, tmp_path):
    shutil.copytree(orbax / "plain", tmp_path / "pipe")
    os.mkfifo(tmp_path / "pipe" / "more")
    with pytest.raises(ValueError, match=r"damaged Orbax checkpoint \(more is no regular file\)"):
        weights.load_orbax(tmp_path / "pipe")
    shutil.copytree(orbax / "plain", tmp_path / "device")
    (tmp_path / "device" / "_METADATA").unlink()
    (tmp_path / "device" / "_METADATA").symlink_to("/dev/zero")
    with pytest.raises(ValueError, match="no Orbax checkpoint"):
        weights.load_orbax(tmp_path / "device")
    (tmp_path / "circle").symlink_to("circle")
    with pytest.raises(ValueError, match="no Orbax checkpoint"):
        weights.load_orbax(tmp_path / "circle")
