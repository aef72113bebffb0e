"""The paper's tables beside ours, and the same simulated data through the solvers that estimate depth.

Everything here is simulated. The helices are the paper's own simulation (Table 1). The hearts are the phantom's, in the
design of the paper's Table 2, whose data are not public.
"""

from fluoromap.paper.tables.depth_figures import DepthFigures
from fluoromap.paper.tables.one_view import OneViewTables, one_view_tables
from fluoromap.paper.tables.table1 import Table1Row
from fluoromap.paper.tables.table2 import Table2Row

__all__ = ["DepthFigures", "OneViewTables", "Table1Row", "Table2Row", "one_view_tables"]
