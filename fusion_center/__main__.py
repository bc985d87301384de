"""``python -m waldnet.fusion_center SCENARIO``."""

from cyclopts import App

from waldnet.common.process import main
from waldnet.fusion_center.app import center

app = App(name="fusion_center", help="The fusion center.")
app.default(center)

if __name__ == "__main__":
    main(app)
