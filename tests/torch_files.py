"""Checkpoints as PyTorch writes them, made with zipfile and pickle alone: stand-ins carry PyTorch's names."""

import collections
import io
import pickle
import zipfile


class Named:
    """Pickles as the global module.name, as it is or called with arguments."""

    def __init__(self, module, name, *arguments, called=True):
        self.place, self.arguments, self.called = (module, name), arguments, called


class Stored:
    """Pickles as the persistent reference to a storage."""

    def __init__(self, kind, key, count):
        self.kind, self.key, self.count = kind, key, count


class Writer(pickle._Pickler):
    """Python's own pickler, with PyTorch's persistent references and globals that need not exist."""

    def persistent_id(self, value):
        if isinstance(value, Stored):
            return ("storage", Named("torch", value.kind, called=False), value.key, "cuda:0", value.count)
        return None

    def save(self, value, save_persistent_id=True):
        if not isinstance(value, Named):
            return super().save(value, save_persistent_id)
        self.write(b"c" + "\n".join(value.place).encode() + b"\n")
        if value.called:
            self.save(tuple(value.arguments))
            self.write(b"R")
        return None


def pickled(value, protocol=2):
    buffer = io.BytesIO()
    Writer(buffer, protocol).dump(value)
    return buffer.getvalue()


def tensor(kind, key, count, offset, shape, strides, function="_rebuild_tensor_v2"):
    rest = (False, collections.OrderedDict()) if function.endswith("v2") else ()
    return Named("torch._utils", function, Stored(kind, key, count), offset, shape, strides, *rest)


def write(path, value, storages=None, *, root="archive", compression=zipfile.ZIP_STORED, more=()):
    with zipfile.ZipFile(path, "w", compression) as archive:
        archive.writestr(f"{root}/data.pkl", value if isinstance(value, bytes) else pickled(value))
        for key, content in (storages or {}).items():
            archive.writestr(f"{root}/data/{key}", content)
        for name, content in (("version", b"3\n"), *more):
            archive.writestr(f"{root}/{name}", content)
    return path
