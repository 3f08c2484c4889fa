"""The points of a person's hand before a webcam, a line of JSON for each frame, by MediaPipe.

python examples/webcam_hand.py hand_landmarker.task | rtee teleop --landmarks -

MediaPipe (`pip install mediapipe`) may be in an environment of its own; hand_landmarker.task is the
model of its hand landmarker.
"""

from __future__ import annotations

import argparse
import json
import sys
import time


def main() -> None:
    """Print what the camera sees until Ctrl-C."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", help="hand_landmarker.task")
    parser.add_argument("--camera", type=int, default=0)
    options = parser.parse_args()
    try:
        import cv2
        import mediapipe as mp
    except ImportError:
        sys.exit("this needs MediaPipe: pip install mediapipe")
    vision = mp.tasks.vision
    settings = vision.HandLandmarkerOptions(
        base_options=mp.tasks.BaseOptions(model_asset_path=options.model),
        running_mode=vision.RunningMode.VIDEO,
        num_hands=2,  # the other one may be in the picture, and is left out by its handedness
    )
    camera = cv2.VideoCapture(options.camera)
    if not camera.isOpened():
        sys.exit(f"there is no camera {options.camera}")
    with vision.HandLandmarker.create_from_options(settings) as landmarker:
        while True:
            there, picture = camera.read()
            if not there:
                sys.exit("the camera gives no more pictures")
            stamp = round(1e3 * time.monotonic())
            image = mp.Image(mp.ImageFormat.SRGB, cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
            found = landmarker.detect_for_video(image, stamp)
            line = {
                "timestamp_ms": stamp,
                "handedness": [[{"category_name": h[0].category_name}] for h in found.handedness],
                "hand_world_landmarks": [
                    [{"x": p.x, "y": p.y, "z": p.z} for p in hand]
                    for hand in found.hand_world_landmarks
                ],
            }
            print(json.dumps(line), flush=True)


if __name__ == "__main__":
    try:
        main()
    except (KeyboardInterrupt, BrokenPipeError):
        sys.exit(0)
