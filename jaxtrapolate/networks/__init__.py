"""The networks, in Flax NNX, and their pure functions for inference."""

from jaxtrapolate.networks.extranet import GATED_CONVOLUTION as GATED_CONVOLUTION
from jaxtrapolate.networks.extranet import ExtraNet as ExtraNet
from jaxtrapolate.networks.extranet import ExtraNetConfig as ExtraNetConfig
from jaxtrapolate.networks.extranet import extranet_from_torch as extranet_from_torch
from jaxtrapolate.networks.inference import fold as fold
from jaxtrapolate.networks.inference import inference as inference
from jaxtrapolate.networks.interpolator import Interpolator as Interpolator
from jaxtrapolate.networks.interpolator import InterpolatorConfig as InterpolatorConfig
