"""From a scene of points, views and masks to a labelled cloud: the half that trains, of the extra 'fit'.

``fit`` puts the stages in order, a file a stage: visibility (with splatting and lanes, its kernel), then grouping, or
features, codebook and matching, or paper; association; membership. tiles does it for clouds too large for one.
"""
