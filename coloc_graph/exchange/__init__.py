"""Other people's formats, in and out: TUM, g2o, a user's own marker tracks in CSV files, ROS bags.

One module a format, imported where it is used; what comes in becomes an ordinary run.
"""
