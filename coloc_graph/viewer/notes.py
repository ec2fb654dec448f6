"""Notes on missing parts of a scene, and notifications in the browsers."""

import viser

from coloc_graph.viewer.scene import Scene

NOTIFICATION_SECONDS = 15  # s until a notification closes by itself


class Notifications:
    """Messages that pop up in all browsers."""

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self.shown: set[str] = set()

    def show(self, title: str, text: str) -> None:
        """Show a message."""
        for client in self._server.get_clients().values():
            client.add_notification(title, text, auto_close_seconds=NOTIFICATION_SECONDS, color="red")

    def show_once(self, title: str, text: str) -> None:
        """Show a message unless it was shown before."""
        if text not in self.shown:
            self.shown.add(text)
            self.show(title, text)


def missing_parts(scene: Scene) -> list[str]:
    """Sentences on everything that a scene cannot show."""
    return [one for one in (*scene.notes, missing_images(scene)) if one]


def missing_images(scene: Scene) -> str:
    """Sentence that names the observers without images and detections in the run; "" if there are none."""
    if scene.run is None:
        return ""
    observing = {robot for stance in scene.stances for robot in stance.observers}
    blind = [
        robot
        for robot in scene.robots
        if robot in observing and not scene.run.has_images(robot) and not scene.run.has_detections(robot)
    ]
    return (
        f"the run holds neither images nor detections of {', '.join(blind)}: their cameras stay empty" if blind else ""
    )
