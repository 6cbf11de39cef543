"""Pointfilter: noisy point clouds in, clean ones out, sharp edges and every attribute kept.

    from pointfilter import Engine, PointCloud, filter_cloud, find_model

    cloud = PointCloud.read("scan.ply")
    clean, report = filter_cloud(cloud, Engine(find_model()))
    clean.write("clean.ply", comment=report.comment)

The method is *Pointfilter: Point Cloud Filtering via Encoder-Decoder Modeling* (Zhang, Lu, Qin, He, 2020).
"""

from importlib.metadata import PackageNotFoundError, version

from pointfilter.cloud import PointCloud
from pointfilter.engine import Engine
from pointfilter.errors import PointfilterError
from pointfilter.filter import Filtered, filter_points
from pointfilter.inspection import Look, look
from pointfilter.limits import ReadLimits
from pointfilter.models import ModelBundle, available_models, find_model, load_bundle
from pointfilter.pipeline import Radius, Report, filter_cloud

try:
    __version__ = version("pointfilter")
except PackageNotFoundError:  # pragma: no cover - a source tree that was never installed
    __version__ = "0+unknown"

__all__ = [
    "Engine",
    "Filtered",
    "Look",
    "ModelBundle",
    "PointCloud",
    "PointfilterError",
    "Radius",
    "ReadLimits",
    "Report",
    "__version__",
    "available_models",
    "filter_cloud",
    "filter_points",
    "find_model",
    "load_bundle",
    "look",
]
