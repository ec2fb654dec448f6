"""Other people's formats, in and out: TUM, g2o, ROS camera_info and bags, MR.CLAM, a user's own marker tracks.

One module a format, imported where it is used; what comes in becomes an ordinary run.
"""
