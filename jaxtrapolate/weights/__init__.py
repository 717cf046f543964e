"""Weights of methods: the library's own files, Orbax checkpoints, and PyTorch checkpoints read without PyTorch.

The files that come with the package lie beside this one.
"""

from jaxtrapolate.weights.files import Weights as Weights
from jaxtrapolate.weights.files import default_weights as default_weights
from jaxtrapolate.weights.files import load_orbax as load_orbax
from jaxtrapolate.weights.files import load_weights as load_weights
from jaxtrapolate.weights.files import read_weights as read_weights
from jaxtrapolate.weights.files import save_weights as save_weights
from jaxtrapolate.weights.pytorch import read_torch as read_torch
from jaxtrapolate.weights.tree import configured as configured
from jaxtrapolate.weights.tree import fingerprint as fingerprint
from jaxtrapolate.weights.tree import fit as fit
