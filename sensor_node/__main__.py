"""``python -m waldnet.sensor_node SCENARIO SENSOR``."""

from cyclopts import App

from waldnet.common.process import main
from waldnet.sensor_node.app import node

app = App(name="sensor_node", help="One sensor node.")
app.default(node)

if __name__ == "__main__":
    main(app)
