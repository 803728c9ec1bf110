"""seaopt."""
from seaopt.plants import *
from seaopt.parameters import *
from seaopt import plants
