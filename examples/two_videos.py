"""Render two videos, A.avi and B.avi, of a robot that drives before two cameras: something to try a recording with."""

import cv2

from coloc_graph import open_run, simulate, write_team

# 20 s at 10 images a second; B's recording begins 1.5 s later
simulate("hallway", "rendered.mcap", depth="images", stances=1, seed=1, points=400, image_format="png")
run = open_run("rendered.mcap")
write_team(run.team, "team.toml")
for robot, begin in (("A", 0), ("B", 15)):
    frames = list(run.images(robot))[begin:]
    video = cv2.VideoWriter(f"{robot}.avi", cv2.VideoWriter_fourcc(*"FFV1"), 10.0, (320, 240), isColor=False)
    for frame in frames:
        video.write(frame.pixels)
    video.release()
    print(f"{robot}.avi: {len(frames)} images")
picture = [frame.pixels for robot in "AB" for frame in list(run.images(robot))[:1]]
cv2.imwrite("two_videos.png", cv2.hconcat(picture))
