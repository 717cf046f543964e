"""Pictures in a page: data URIs, scaled down."""

import base64
import io
from pathlib import Path
from typing import Any

from PIL import Image, features

_KINDS = {".png": "png", ".jpg": "jpeg", ".jpeg": "jpeg", ".webp": "webp", ".gif": "gif"}
_QUALITY = 85


class Pictures:
    """Pictures of one folder as data URIs; those that are not there are remembered in `missing`."""

    def __init__(self, folder: Path):
        self.folder = folder.resolve()
        self.missing: list[str] = []

    def uri(self, path: Any) -> str | None:
        """The picture at a path relative to the folder, None where there is none.

        A PNG goes into the page as WebP: without loss where it has at most 256 colours (error maps, masks, causes),
        else of high quality.
        """
        if not isinstance(path, str) or not path:
            return None
        try:
            place = (self.folder / path).resolve()
            kind = _KINDS.get(place.suffix.lower())
            if kind is None or not place.is_relative_to(self.folder):
                raise OSError("not a picture of this folder")
            content = place.read_bytes()
            if kind == "png" and features.check("webp"):
                kind, content = "webp", _webp(content)
        except (OSError, ValueError, SyntaxError):
            self.missing.append(path)
            return None
        return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _webp(png: bytes) -> bytes:
    buffer = io.BytesIO()
    with Image.open(io.BytesIO(png)) as image:
        few = image.getcolors(256) is not None
        image.save(buffer, format="WEBP", lossless=few, quality=50 if few else _QUALITY, method=4)
    return buffer.getvalue()
