"""The filters and tests by themselves: arrays in, arrays out, leading batch axes everywhere.

Lengths are metres, times seconds, angles radians; states begin with the position (east, north(, up)). Plain numbers and
lists are welcome where a density, plots or a time is given. What is where:

- **Densities**: ``Gaussian``; ``product`` with its normalisation constant.
- **Motion**: ``ConstantVelocity``, ``ConstantAcceleration``, ``CoordinatedTurn``, several of them as ``Imm``;
  ``predict``.
- **Sensors**: ``Sensor`` with what it measures (``Position``, ``Polar``, ``PolarDoppler``, ``Bearing``), where it sees
  (``Box``, ``Disc``, ``Sector``, ...), and how its detection depends on the target (``Swerling``, ``Notch``).
- **Filters**: ``kalman_filter``, ``nearest_neighbour``, ``pdaf``, ``jpda``, ``imm_pdaf``; ``mixture_step`` is the
  multi-hypothesis tracker.
- **Test**: ``thresholds`` and ``decide`` are Wald's test; ``log_lambda`` is its step at the fusion center.
- **Distribution**: ``Share(1)`` is naive fusion, ``Share(n_sensors)`` federated; ``globalise`` makes it the distributed
  Kalman filter.
- **Extraction**: ``extract`` tests possible targets as sums of sub-tracks, ``extract_cluster`` groups of unknown size.
- **Retrodiction**: ``smooth`` for single densities, ``histories`` and ``descendants`` for mixtures.
"""

from waldnet.common.estimation.association import Clutter as Clutter
from waldnet.common.estimation.association import Expected as Expected
from waldnet.common.estimation.association import Filtered as Filtered
from waldnet.common.estimation.association import Plots as Plots
from waldnet.common.estimation.association import expect as expect
from waldnet.common.estimation.association import kalman as kalman
from waldnet.common.estimation.association import kalman_filter as kalman_filter
from waldnet.common.estimation.association import nearest as nearest
from waldnet.common.estimation.association import nearest_neighbour as nearest_neighbour
from waldnet.common.estimation.association import normalise as normalise
from waldnet.common.estimation.association import pdaf as pdaf
from waldnet.common.estimation.association import update as update
from waldnet.common.estimation.cluster import Cluster as Cluster
from waldnet.common.estimation.cluster import ClusterTest as ClusterTest
from waldnet.common.estimation.cluster import Joint as JointHistories
from waldnet.common.estimation.cluster import cluster as cluster
from waldnet.common.estimation.cluster import extract_cluster as extract_cluster
from waldnet.common.estimation.detection import Constant as Constant
from waldnet.common.estimation.detection import Detection as Detection
from waldnet.common.estimation.detection import Notch as Notch
from waldnet.common.estimation.detection import Swerling as Swerling
from waldnet.common.estimation.detection import cumulative as cumulative
from waldnet.common.estimation.detection import cumulative_rate as cumulative_rate
from waldnet.common.estimation.detection import revisit_interval as revisit_interval
from waldnet.common.estimation.extraction import Candidates as Candidates
from waldnet.common.estimation.extraction import Extractor as Extractor
from waldnet.common.estimation.extraction import SensorScan as SensorScan
from waldnet.common.estimation.extraction import candidates as candidates
from waldnet.common.estimation.extraction import extract as extract
from waldnet.common.estimation.extraction import seeds as seeds
from waldnet.common.estimation.extraction import together as together
from waldnet.common.estimation.field_of_view import AllAround as AllAround
from waldnet.common.estimation.field_of_view import Box as Box
from waldnet.common.estimation.field_of_view import Disc as Disc
from waldnet.common.estimation.field_of_view import Everywhere as Everywhere
from waldnet.common.estimation.field_of_view import FieldOfView as FieldOfView
from waldnet.common.estimation.field_of_view import View as View
from waldnet.common.estimation.gaussian import Gaussian as Gaussian
from waldnet.common.estimation.gaussian import Product as Product
from waldnet.common.estimation.gaussian import log_pdf as log_pdf
from waldnet.common.estimation.gaussian import log_sum_exp as log_sum_exp
from waldnet.common.estimation.gaussian import moments as moments
from waldnet.common.estimation.gaussian import product as product
from waldnet.common.estimation.imm import FilteredModes as FilteredModes
from waldnet.common.estimation.imm import Imm as Imm
from waldnet.common.estimation.imm import Modes as Modes
from waldnet.common.estimation.imm import imm_pdaf as imm_pdaf
from waldnet.common.estimation.imm import merge as merge_modes
from waldnet.common.estimation.imm import predict_modes as predict_modes
from waldnet.common.estimation.imm import start as start_modes
from waldnet.common.estimation.joint import Joint as JointWeights
from waldnet.common.estimation.joint import joint as associate_jointly
from waldnet.common.estimation.jpda import jpda as jpda
from waldnet.common.estimation.mixture import EXACT as EXACT
from waldnet.common.estimation.mixture import Ancestry as Ancestry
from waldnet.common.estimation.mixture import Mixture as Mixture
from waldnet.common.estimation.mixture import Reduction as Reduction
from waldnet.common.estimation.mixture import single as start_mixture
from waldnet.common.estimation.mixture import step as mixture_step
from waldnet.common.estimation.mixture import step_traced as mixture_step_traced
from waldnet.common.estimation.motion import ConstantAcceleration as ConstantAcceleration
from waldnet.common.estimation.motion import ConstantVelocity as ConstantVelocity
from waldnet.common.estimation.motion import CoordinatedTurn as CoordinatedTurn
from waldnet.common.estimation.motion import Motion as Motion
from waldnet.common.estimation.motion import predict as predict
from waldnet.common.estimation.polar import Bearing as Bearing
from waldnet.common.estimation.polar import Polar as Polar
from waldnet.common.estimation.polar import PolarDoppler as PolarDoppler
from waldnet.common.estimation.pose import SensorPose as SensorPose
from waldnet.common.estimation.ratio import log_lambda as log_lambda
from waldnet.common.estimation.representation import Global as Global
from waldnet.common.estimation.representation import Share as Share
from waldnet.common.estimation.representation import globalise as globalise
from waldnet.common.estimation.representation import shrink as shrink
from waldnet.common.estimation.retrodiction import Generation as Generation
from waldnet.common.estimation.retrodiction import Histories as Histories
from waldnet.common.estimation.retrodiction import Retrodicted as Retrodicted
from waldnet.common.estimation.retrodiction import backward as backward
from waldnet.common.estimation.retrodiction import descendants as descendants
from waldnet.common.estimation.retrodiction import generation as generation
from waldnet.common.estimation.retrodiction import histories as histories
from waldnet.common.estimation.retrodiction import smooth as smooth
from waldnet.common.estimation.sector import Sector as Sector
from waldnet.common.estimation.sensing import Linearised as Linearised
from waldnet.common.estimation.sensing import Measurement as Measurement
from waldnet.common.estimation.sensing import Position as Position
from waldnet.common.estimation.sensing import Sensor as Sensor
from waldnet.common.estimation.sprt import Existence as Existence
from waldnet.common.estimation.sprt import Status as Status
from waldnet.common.estimation.sprt import Thresholds as Thresholds
from waldnet.common.estimation.sprt import Verdict as Verdict
from waldnet.common.estimation.sprt import decide as decide
from waldnet.common.estimation.sprt import decide_with_life as decide_with_life
from waldnet.common.estimation.sprt import survive as survive
from waldnet.common.estimation.sprt import thresholds as thresholds
from waldnet.common.estimation.visibility import Visibility as Visibility

__all__ = [
    "EXACT",
    "AllAround",
    "Ancestry",
    "Bearing",
    "Box",
    "Candidates",
    "Cluster",
    "ClusterTest",
    "Clutter",
    "Constant",
    "ConstantAcceleration",
    "ConstantVelocity",
    "CoordinatedTurn",
    "Detection",
    "Disc",
    "Everywhere",
    "Existence",
    "Expected",
    "Extractor",
    "FieldOfView",
    "Filtered",
    "FilteredModes",
    "Gaussian",
    "Generation",
    "Global",
    "Histories",
    "Imm",
    "JointHistories",
    "JointWeights",
    "Linearised",
    "Measurement",
    "Mixture",
    "Modes",
    "Motion",
    "Notch",
    "Plots",
    "Polar",
    "PolarDoppler",
    "Position",
    "Product",
    "Reduction",
    "Retrodicted",
    "Sector",
    "Sensor",
    "SensorPose",
    "SensorScan",
    "Share",
    "Status",
    "Swerling",
    "Thresholds",
    "Verdict",
    "View",
    "Visibility",
    "associate_jointly",
    "backward",
    "candidates",
    "cluster",
    "cumulative",
    "cumulative_rate",
    "decide",
    "decide_with_life",
    "descendants",
    "expect",
    "extract",
    "extract_cluster",
    "generation",
    "globalise",
    "histories",
    "imm_pdaf",
    "jpda",
    "kalman",
    "kalman_filter",
    "log_lambda",
    "log_pdf",
    "log_sum_exp",
    "merge_modes",
    "mixture_step",
    "mixture_step_traced",
    "moments",
    "nearest",
    "nearest_neighbour",
    "normalise",
    "pdaf",
    "predict",
    "predict_modes",
    "product",
    "revisit_interval",
    "seeds",
    "shrink",
    "smooth",
    "start_mixture",
    "start_modes",
    "survive",
    "thresholds",
    "together",
    "update",
]
