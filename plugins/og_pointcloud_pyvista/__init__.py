"""og_pointcloud in PyVista, through its entry points: no import needed once both are installed.

    import pyvista as pv

    mesh = pv.read("kitchen.ogpc")                        # or any dataset of your own, with scene= below
    mesh = mesh.og.segment(["chair", "table"])            # a new dataset: og_label, og_instance, og_score, og_color
    mesh.og.select("mug"), mesh.og.boxes()

    plotter = pv.Plotter()
    plotter.og.add_segmentation(mesh)                     # colors, legend with counts, names on the instances
    plotter.og.add_boxes(mesh)
    plotter.og.enable_click_query()                       # click: the instance, its best words and scores
    plotter.show()

One file per subject: ``datasets`` (what ``mesh.og`` does), ``plotting`` (what ``plotter.og`` does), ``files`` (.ogpc).
"""

from og_pointcloud_pyvista.datasets import OgDataSet, to_pyvista
from og_pointcloud_pyvista.files import read_ogpc
from og_pointcloud_pyvista.plotting import OgPlotter, can_render

__all__ = ["OgDataSet", "OgPlotter", "can_render", "read_ogpc", "to_pyvista"]
