"""Convert other formats: TUM, g2o, ROS camera_info and bags, MR.CLAM, and a user's own images and marker tracks.

One module for each format, imported where it is used; imported data becomes an ordinary run.
"""
