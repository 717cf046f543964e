"""How far images are from the truth: PSNR and SSIM, perceptual metrics by optional packages, and all by name."""

from jaxtrapolate.metrics.image import mse as mse
from jaxtrapolate.metrics.image import psnr as psnr
from jaxtrapolate.metrics.image import ssim as ssim
from jaxtrapolate.metrics.image import ssim_map as ssim_map
from jaxtrapolate.metrics.registry import METRICS as METRICS
from jaxtrapolate.metrics.registry import Metric as Metric
from jaxtrapolate.metrics.registry import load as load
from jaxtrapolate.metrics.registry import metric_names as metric_names
