"""Unreal-style EXR dumps: `<Scene><Buffer>.<0000>.exr`, one file for each buffer of each frame.

| buffer | field | as stored |
|---|---|---|
| PreTonemapHDRColor | color | linear radiance |
| MotionVector | motion | R, G: current minus previous in pixels, y up (another convention can be stated) |
| BaseColor | albedo | |
| SceneDepth | depth | centimetres * 1e-4 |
| WorldNormal | normal | exactly (-1, -1, -1) at the sky |
| WorldPosition | position | centimetres |
| Roughness, Metallic, Specular, NoV | roughness, metallic, specular, n_dot_v | |
| MyStencil | stencil | 0 static, > 0 the id of a dynamic object |
| Shadow | shadow | 1 = light fully blocked by dynamic objects |
| Sky | sky | 1 = nothing hit; without it the sky is where the normal is (-1, -1, -1) or there is no depth |
| Skybox or SkyboxColor | sky_color | linear radiance |
| ForwardFlow, BackwardFlow | of the keyframe | R, G: pixels to add, y down; B: change of depth in metres |

The unit of position, and so of depth and of its changes, is the centimetre. Buffers of one channel may be stored with
one or as grey with three, colours as one channel of grey. Depth is +inf where the sky is, whatever is stored there, and
where it is not positive (`jaxtrapolate.files.repair`). Numbers may be negative; where two files are of one frame, as
`.1.exr` and `.0001.exr`, one is left out, and a note says which; another note names EXR files of no known buffer. Frame
0000, which the release of ExtraNet drops, is kept: it serves as history. Only a first frame that has no MotionVector at
all, while others have, is left out (`FileSequence.notes`).
"""

import os
import re
from collections.abc import Iterable
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from jaxtrapolate.atomic import os_input_error
from jaxtrapolate.errors import InputError
from jaxtrapolate.files.convention import unconvert
from jaxtrapolate.files.exr import read_exr, write_exr
from jaxtrapolate.files.ids import StaticId
from jaxtrapolate.files.listing import Files, collect, folder_name, frame_number, list_folder, some
from jaxtrapolate.files.reader import BUFFERS, FLOWS, FileSequence, Opened, pick_channels
from jaxtrapolate.files.repair import nothing_hit
from jaxtrapolate.files.sequence import MotionConvention
from jaxtrapolate.records import Frame, Keyframe, check_frame

NAMES = {
    "color": "PreTonemapHDRColor",
    "motion": "MotionVector",
    "albedo": "BaseColor",
    "depth": "SceneDepth",
    "normal": "WorldNormal",
    "position": "WorldPosition",
    "roughness": "Roughness",
    "metallic": "Metallic",
    "specular": "Specular",
    "n_dot_v": "NoV",
    "stencil": "MyStencil",
    "shadow": "Shadow",
    "sky": "Sky",
    "sky_color": "Skybox",
    "forward_flow": "ForwardFlow",
    "backward_flow": "BackwardFlow",
}
"""The name in the files of every buffer."""

CONVENTION = MotionConvention("current_minus_previous", "pixels", "up")
"""How an Unreal dump states its motion vectors."""

_FIELDS = {name: field for field, name in NAMES.items()} | {"SkyboxColor": "sky_color"}
_FILE = re.compile(rf"(?P<scene>.*?)(?P<buffer>{'|'.join(_FIELDS)})\.(?P<number>-?\d+)\.exr", re.IGNORECASE)
_OTHER = re.compile(r".*\.-?\d+\.exr", re.IGNORECASE)
_LOWER = {name.lower(): field for name, field in _FIELDS.items()}

_DEPTH_TO_CM = 1e4
_METRES_TO_CM = 100.0
_SKY_NORMAL = -1.0
_SINGLE = ("motion", "position", "depth", "stencil", *FLOWS)


def unreal_files(names: list[str]) -> dict[str, tuple[Files, list[str]]]:
    """For each scene the file of each buffer by frame, and a line for each that is left out (`collect`)."""
    scenes: dict[str, list[tuple[int, str, str, bool]]] = {}
    for name in names:
        if match := _FILE.fullmatch(name):
            number = frame_number(match["number"], name)
            usual = match["number"] == f"{number:04d}" and match["buffer"] in _FIELDS
            field = _LOWER[match["buffer"].lower()]
            scenes.setdefault(match["scene"], []).append((number, field, name, usual))
    return {scene: collect(found) for scene, found in scenes.items()}


class UnrealSequence(FileSequence):
    """An Unreal-style EXR dump; see the module's docstring for the files and their units.

    Args:
        folder: where the files are.
        scene: which one, where the folder holds several.
        motion: how the motion vectors are stated, where it is not the default `CONVENTION`.
        name: for reports; by default the folder's, and the scene's in brackets where it differs.
        step: as in `FileSequence`.
        static_ids: as in `FileSequence`.
        strict: as in `FileSequence`.

    Raises:
        InputError: no such folder, no such files, several scenes, a missing file, files of different sizes.
    """

    outside = MappingProxyType({**FileSequence.outside, "normal": _SKY_NORMAL})

    def __init__(
        self,
        folder: str | os.PathLike[str],
        *,
        scene: str | None = None,
        motion: MotionConvention | None = None,
        name: str | None = None,
        step: int | None = None,
        static_ids: Iterable[StaticId] = (),
        strict: bool = False,
    ) -> None:
        names = list_folder(folder)
        scenes = unreal_files(names)
        if scene is None and len(scenes) > 1:
            found = ", ".join(map(repr, sorted(scenes)))
            raise InputError(f"{folder}: holds several scenes ({found}); put each into a folder of its own")
        prefix = scene if scene is not None else next(iter(scenes), "")
        if prefix not in scenes:
            of_scene = "" if scene is None else f" of scene {scene!r}"
            raise InputError(f"{folder}: no files{of_scene} named <Scene><Buffer>.<0000>.exr; give the dump's folder")
        files, left_out = scenes[prefix]
        super().__init__(
            folder,
            files,
            name=name or folder_name(folder, prefix),
            hdr=True,
            depth="metric",
            convention=motion or CONVENTION,
            step=step,
            static_ids=static_ids,
            left_out=left_out,
            strict=strict,
        )
        if others := [file for file in names if _OTHER.fullmatch(file) and not _FILE.fullmatch(file)]:
            self.notes += (f"{some(others)} not read: the names are of no buffer of an Unreal dump",)

    def _read(self, path: Path, buffer: str, opened: Opened) -> np.ndarray:
        stored = read_exr(path)
        image = pick_channels(stored, path=path, buffer=buffer)
        if buffer == "color":
            return self._exr_color(path, image, stored)
        if buffer == "depth":
            with np.errstate(over="ignore"):  # The largest float stands for the sky, as +inf does.
                image *= np.float32(_DEPTH_TO_CM)
        elif buffer in FLOWS:
            image[..., 2] *= np.float32(_METRES_TO_CM)
        return image

    def _derive(self, buffers: dict[str, np.ndarray]) -> None:
        if "normal" not in buffers:
            return
        sky = (buffers["normal"] == _SKY_NORMAL).all(axis=-1, keepdims=True)
        buffers["normal"] = np.where(sky, np.float32(0), buffers["normal"])
        if "sky" not in buffers:
            buffers["sky"] = (sky | nothing_hit(buffers["depth"]) if "depth" in buffers else sky).astype(np.float32)


def write_unreal_frame(
    folder: str | os.PathLike[str],
    scene: str,
    number: int,
    frame: Frame,
    *,
    keyframe: Keyframe | None = None,
    unit: float = 1.0,
    half: bool = True,
) -> list[Path]:
    """Write a frame as `UnrealSequence` reads it, one file for each buffer that is there, each in full or not at all.

    Args:
        folder: created where it does not exist.
        scene: the first part of the files' names.
        number: of the frame, at least four digits in the files' names.
        frame: in the library's conventions.
        keyframe: its flows are written too; its colour, depth and stencil are the frame's.
        unit: centimetres in a unit of position; the reader gives centimetres back.
        half: 16-bit floats for colours, normals and materials. Motion, flows, position, depth, ids are always 32-bit.

    Returns:
        The files.

    Raises:
        InputError: no permission, or disk full.
    """
    check_frame("frame", frame)
    buffers: dict[str, Any] = {"color": frame.color}
    if frame.motion is not None:
        buffers["motion"] = unconvert(np.asarray(frame.motion), CONVENTION)
    if frame.gbuffer is not None:
        buffers |= {field: getattr(frame.gbuffer, field) for field in BUFFERS if hasattr(frame.gbuffer, field)}
    buffers |= {flow: getattr(keyframe, flow) for flow in FLOWS if keyframe is not None}
    images = {buffer: np.array(image, np.float32) for buffer, image in buffers.items() if image is not None}
    _encode_units(images, unit)
    try:
        os.makedirs(folder, exist_ok=True)
    except FileExistsError as error:
        raise InputError(f"{folder}: is a file; choose another folder") from error
    except OSError as error:
        raise os_input_error(folder, error, action="write") from error
    paths = []
    for buffer, image in images.items():
        if image.shape[-1] == 2:
            image = np.concatenate([image, np.zeros_like(image[..., :1])], axis=-1)
        paths.append(Path(folder) / f"{scene}{NAMES[buffer]}.{number:04d}.exr")
        write_exr(paths[-1], image.repeat(3 // image.shape[-1], axis=-1), half=half and buffer not in _SINGLE)
    return paths


def _encode_units(images: dict[str, np.ndarray], unit: float) -> None:
    """From the library's units and sky to those of the files, in place."""
    if "position" in images:
        images["position"] *= np.float32(unit)
    if "depth" in images:
        images["depth"] *= np.float32(unit / _DEPTH_TO_CM)
    for flow in FLOWS:
        if flow in images:
            images[flow][..., 2] *= np.float32(unit / _METRES_TO_CM)
    if "normal" in images and "sky" in images:
        sky = images["sky"] == 1
        images["normal"] = np.where(sky, np.float32(_SKY_NORMAL), images["normal"])
        follows = sky | nothing_hit(images["depth"]) if "depth" in images else sky
        if (images["sky"] == follows).all():
            del images["sky"]
