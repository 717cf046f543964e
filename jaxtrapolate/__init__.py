"""Frame extrapolation and interpolation for rendered sequences, as pure jitted JAX functions.

Names are imported when they are first used; `__init__.pyi` says where from.
"""

import lazy_loader

from jaxtrapolate._version import __version__ as __version__

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
