"""Training: one loop for all networks, configured by TOML files; `jaxtrapolate train`."""

from functools import partial

from jaxtrapolate.methods import guided_net
from jaxtrapolate.training.checkpoints import model_arrays as model_arrays
from jaxtrapolate.training.config import Config as Config
from jaxtrapolate.training.config import Optimizer as Optimizer
from jaxtrapolate.training.config import config_names as config_names
from jaxtrapolate.training.config import load_config as load_config
from jaxtrapolate.training.config import parse_config as parse_config
from jaxtrapolate.training.extranet import ExtraNetOptions, ExtraNetTask
from jaxtrapolate.training.extrass import ExtraSSOptions, ExtraSSTask
from jaxtrapolate.training.frnet import FRNetOptions, FRNetTask
from jaxtrapolate.training.interpolator import InterpolatorOptions, InterpolatorTask
from jaxtrapolate.training.loop import TrainingError as TrainingError
from jaxtrapolate.training.loop import train_and_evaluate as train_and_evaluate
from jaxtrapolate.training.tasks import TASKS as TASKS
from jaxtrapolate.training.tasks import Entry as Entry
from jaxtrapolate.training.tasks import Task as Task

TASKS["extranet"] = Entry(ExtraNetOptions, ExtraNetTask)
TASKS["guided_net"] = Entry(ExtraNetOptions, partial(ExtraNetTask, method=guided_net.NAME))
TASKS["extrass"] = Entry(ExtraSSOptions, ExtraSSTask)
TASKS["extrass_refine"] = Entry(FRNetOptions, FRNetTask)
TASKS["interpolator"] = Entry(InterpolatorOptions, InterpolatorTask)
