"""From a scene of points, views and masks to a labelled cloud: the half that trains, of the extra 'fit'.

``fit`` puts the stages in order, a file a stage: held_out (the size of points), mask_table, see_through, grouping or
one of the ``learned``, membership, association, reliability. tiles does it for clouds too large for one.
"""
