"""Public functions: what the commands do, without a terminal.

Datasets, runs and robots are given as paths or as objects. Every function returns one frozen result
(api/results.py). Nothing is printed: `progress` is called with done, total and a note, and messages
go to the logger "gaponet".
"""

from gaponet.api.files import export_network as export_network
from gaponet.api.files import export_robot as export_robot
from gaponet.api.files import randomization as randomization
from gaponet.api.fit import adapt_model as adapt_model
from gaponet.api.fit import adapt_robot as adapt_robot
from gaponet.api.fit import identify as identify
from gaponet.api.fit import identify_torque as identify_torque
from gaponet.api.fit import train as train
from gaponet.api.logs import collect as collect
from gaponet.api.logs import doctor as doctor
from gaponet.api.logs import excite as excite
from gaponet.api.logs import import_logs as import_logs
from gaponet.api.measure import check as check
from gaponet.api.measure import evaluate as evaluate
from gaponet.api.measure import gap as gap
from gaponet.api.measure import pair as pair
from gaponet.api.measure import replay as replay
from gaponet.api.robots import networks as networks
