"""Our own network as a method: ExtraNet's stages, the network corrects the image of `shading_warp`."""

from os import PathLike

from jaxtrapolate.methods.extranet import Preparation, extranet, read_network
from jaxtrapolate.methods.method import Method
from jaxtrapolate.networks.extranet import ExtraNet, ExtraNetConfig

NAME = "guided_net"

NETWORK = ExtraNetConfig(norm=False, direct=True, contrast=4.0, guess=4)
"""The network of the default weights: no batch norms, histories at full resolution too, images as differences."""

PREPARATION = Preparation(first_guess="shading", space="tone")
"""What it is shown: the image of `shading_warp`, how its light has moved, and how old what it shows is."""


def guided_net(model: ExtraNet, *, preparation: Preparation = PREPARATION) -> Method:
    """The image of `shading_warp`, corrected by a network that sees three warped rendered frames and target's buffers.

    The method `extranet` but for its configuration: see there for what the network is shown and what is left out.

    Args:
        model: of any configuration; that of the default weights is `NETWORK`.
        preparation: what the model was trained on.

    Raises:
        ValueError: as `extranet`.

    References:
        Guo et al. 2021 (ExtraNet) and, for the first guess, Wu et al. 2023 (ExtraSS). Departures from the former: the
        first guess, `NETWORK`, and the loss; what each is worth is in experiments/README.md.
    """
    return extranet(model, preparation=preparation, name=NAME)


def load(path: str | PathLike[str]) -> Method:
    """The method with the weights in a file; see `jaxtrapolate.methods.extranet.read_network`."""
    model, preparation = read_network(path, NAME)
    return guided_net(model, preparation=preparation)
