"""The networks, in Flax NNX, and their pure functions for inference."""

from jaxtrapolate.networks.extranet import GATED_CONVOLUTION as GATED_CONVOLUTION
from jaxtrapolate.networks.extranet import ExtraNet as ExtraNet
from jaxtrapolate.networks.extranet import ExtraNetConfig as ExtraNetConfig
from jaxtrapolate.networks.extranet import extranet_from_torch as extranet_from_torch
from jaxtrapolate.networks.extrass import ExtraSS as ExtraSS
from jaxtrapolate.networks.extrass import ExtraSSConfig as ExtraSSConfig
from jaxtrapolate.networks.extrass import ExtraSSNet as ExtraSSNet
from jaxtrapolate.networks.extrass import ExtraSSNetConfig as ExtraSSNetConfig
from jaxtrapolate.networks.extrass import SuperSampled as SuperSampled
from jaxtrapolate.networks.frnet import FRNet as FRNet
from jaxtrapolate.networks.frnet import FRNetConfig as FRNetConfig
from jaxtrapolate.networks.frnet import Refined as Refined
from jaxtrapolate.networks.inference import fold as fold
from jaxtrapolate.networks.inference import inference as inference
from jaxtrapolate.networks.interpolator import Interpolator as Interpolator
from jaxtrapolate.networks.interpolator import InterpolatorConfig as InterpolatorConfig
