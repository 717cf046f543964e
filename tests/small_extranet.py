"""A small network with random weights, and random windows that it is shown."""

import jax
import jax.numpy as jnp
import numpy as np
import oracles
from flax import nnx

import jaxtrapolate as jx
from jaxtrapolate.evaluation.windows import hide
from jaxtrapolate.methods.extranet import extranet
from jaxtrapolate.methods.extrass import extrass_refine
from jaxtrapolate.methods.extrass_joint import extrass
from jaxtrapolate.networks.extranet import ExtraNet, ExtraNetConfig
from jaxtrapolate.networks.extrass import ExtraSS, ExtraSSConfig, ExtraSSNetConfig
from jaxtrapolate.networks.frnet import FRNet, FRNetConfig

SMALL = ExtraNetConfig(widths=(4, 6))
SIZE = (9, 13)


def make_window(size=SIZE, *, rendered=3, seed=0, sky=True):
    """Random buffers in centimetres: `rendered` frames with colour in turn with frames without, then the target."""
    height, width = size
    frames = []
    for time in range(2 * rendered):
        rng = np.random.default_rng((seed, time))

        def uniform(channels, low=0.0, high=1.0, rng=rng):
            return rng.uniform(low, high, (height, width, channels)).astype(np.float32)

        albedo = np.where(uniform(3) < 0.15, 0, uniform(3, 0.02)).astype(np.float32)
        infinite = (uniform(1) < 0.15).astype(np.float32) if sky else np.zeros((height, width, 1), np.float32)
        normal = np.float32([0.2, 0.1, 1]) + uniform(3, -0.3, 0.3)
        normal = np.where(infinite > 0.5, 0, normal / np.linalg.norm(normal, axis=-1, keepdims=True))
        buffers = jx.GBuffer(
            albedo=albedo,
            depth=np.where(infinite > 0.5, np.float32(3e6), uniform(1, 200, 5000)),
            normal=normal.astype(np.float32),
            position=uniform(3, 0, 40),
            roughness=uniform(1),
            metallic=uniform(1),
            specular=uniform(1),
            n_dot_v=uniform(1, -1),
            stencil=np.floor(uniform(1, 0, 2.2)),
            sky=infinite,
        )
        color, motion = uniform(3, -0.2, 4), oracles.random_motion(height, width, seed=seed + 10 * time)
        frames.append(jx.Frame(color=color, gbuffer=buffers, motion=motion, time=float(time)))
    *history, target = jax.device_put([frame if k % 2 == 0 else hide(frame) for k, frame in enumerate(frames)])
    return tuple(history), target


def random_model(config, build=ExtraNet):
    """A network with random weights; made from shapes alone, because an initialisation compiles layer by layer."""
    structure, state = nnx.split(nnx.eval_shape(lambda: build(config, rngs=nnx.Rngs(0))))
    rng = np.random.default_rng(3)

    def values(path, leaf):
        low, high = (0.5, 1.5) if path[-1].key in ("var", "scale") else (-0.25, 0.25)
        return jnp.asarray(rng.uniform(low, high, leaf.shape), leaf.dtype)

    tree = jax.tree_util.tree_map_with_path(values, nnx.to_pure_dict(state))
    nnx.replace_by_pure_dict(state, tree)
    return nnx.merge(structure, state)


def load(name):
    """A method by name; those without default weights with small networks of random ones."""
    if name == "extranet":
        return extranet(random_model(SMALL))
    if name == "extrass_refine":
        return extrass_refine(random_model(FRNetConfig(widths=(4, 6)), FRNet))
    if name == "extrass":
        sampler = ExtraSSNetConfig(widths=(4, 6), bottleneck=8)
        return extrass(random_model(ExtraSSConfig(FRNetConfig(widths=(4, 6)), sampler), ExtraSS))
    return jx.load(name)


def image_of(method, history, target):
    """Stage by stage, so that little is compiled anew."""
    return np.asarray(method.function(method.state, (), history, target)[1])
