"""Sets of images with cameras, as other programs keep them: Blender/NeRF transforms
and COLMAP models.
"""

from mi_splat.datasets.dataset import Dataset, is_dataset, load_dataset
from mi_splat.datasets.errors import DatasetError, DatasetWarning
from mi_splat.io.points import PointCloud

__all__ = [
    "Dataset",
    "DatasetError",
    "DatasetWarning",
    "PointCloud",
    "is_dataset",
    "load_dataset",
]
