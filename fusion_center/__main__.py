"""``python -m fusion_center SCENARIO``."""

from cyclopts import App

from common.process import main
from fusion_center.app import center

app = App(name="fusion_center", help="The fusion center.")
app.default(center)

if __name__ == "__main__":
    main(app)
