# The public names of greybox, written once: an editor reads them here, and __init__.py loads them at first use.
from greybox import examples as examples
from greybox.automatic import fit as fit
from greybox.commands.chain.front_door import identify as identify
from greybox.commands.front_door import compare as compare
from greybox.commands.front_door import export as export
from greybox.commands.front_door import frf as frf
from greybox.commands.front_door import load as load
from greybox.commands.front_door import profile as profile
from greybox.data import dataset_from_arrays as dataset_from_arrays
from greybox.data.logs import read_logs as read_logs
from greybox.discovery.workflow import discover as discover
from greybox.linear.fit import fit_linear as fit_linear
from greybox.model.faults import check as check
from greybox.model.model import build_model as build_model
from greybox.model.vehicle import read_vehicle as read_vehicle
from greybox.planning.plan import plan as plan
from greybox.residual.from_gpytorch import from_gpytorch as from_gpytorch
from greybox.residual.learn import learn as learn
from greybox.simulators.make import twin as twin
from greybox.validation.validate import validate as validate

__all__: list[str]
__version__: str

_MOVED: dict[str, str]
