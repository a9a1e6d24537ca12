#!/usr/bin/env python3
"""Compares rectification with OpenCV's, for all lens models with and without R, P, region of interest and binning.

    pip install numpy opencv-python-headless
    opencv_rectify.py RECTIFY        (the program made by `cargo build --release -p storm-node --example rectify`)

A picture is cut to a region of interest and averaged over the binning's blocks, as a sensor does. OpenCV rectifies it
(initUndistortRectifyMap and remap, or their fisheye kin) with D and R as the CameraInfo has them and K and P moved into
the cut picture: less the region's corner, and the centre of a block of pixels is the centre of its pixel. (image_geometry
divides the centre by the binning without that half pixel; it is exact for sensors that skip pixels instead of averaging.)
Ours gets the same picture and the whole sensor's CameraInfo. The mean difference over the pixels that both see must be
below one grey level; printed beside it are the largest, and the mean difference when OpenCV's picture is moved by a
quarter of a pixel, so that one sees that the measure is sharp. Exit code 1 when a case fails.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np

WIDTH, HEIGHT = 640, 400
LIMIT = 1.0
# Pixels nearer than this to what one of the two does not see are not compared.
MARGIN = 3


def picture(seed):
    """Waves and blurred noise: detail down to a few pixels in every direction."""
    rng = np.random.default_rng(seed)
    noise = rng.uniform(0, 255, (HEIGHT, WIDTH, 3)).astype(np.float32)
    noise = cv2.GaussianBlur(noise, (0, 0), 2.5)
    noise = (noise - noise.mean()) * (45 / noise.std())
    y, x = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float32)
    waves = np.stack([40 * np.sin(x / 9 + y / 31 + c) + 25 * np.sin(y / 11 - x / 47 + 2 * c) for c in range(3)], -1)
    return np.clip(128 + noise + waves, 0, 255).astype(np.uint8)


def rotation(x, y, z):
    return cv2.Rodrigues(np.array([x, y, z], float))[0]


K = np.array([[420.0, 0, 325.3], [0, 410.0, 196.2], [0, 0, 1]])
P = np.array([[380.0, 0, 310, 0], [0, 385.0, 205, 0], [0, 0, 1, 0]])
STEREO_P = P + np.array([[0, 0, 0, -45.6], [0] * 4, [0] * 4])
NO_TURN, TURN = np.eye(3), rotation(0.03, -0.05, 0.02)
MODELS = {
    "plumb_bob 4": ("plumb_bob", [-0.22, 0.06, 0.0011, -0.0013]),
    "plumb_bob 5": ("plumb_bob", [-0.22, 0.06, 0.0011, -0.0013, -0.005]),
    "plumb_bob 8": ("plumb_bob", [0.4, -0.1, 0.001, -0.002, 0.02, 0.62, -0.02, 0.01]),
    "rational 8": ("rational_polynomial", [0.4, -0.1, 0.001, -0.002, 0.02, 0.62, -0.02, 0.01]),
    "thin prism 12": ("rational_polynomial", [0.4, -0.1, 0.001, -0.002, 0.02, 0.62, -0.02, 0.01, 0.002, -0.001, 0.001, 0.002]),
    "equidistant": ("equidistant", [0.03, -0.01, 0.004, -0.0005]),
    "none": ("plumb_bob", [0.0] * 5),
    "unknown, zero": ("pinhole", [0.0] * 5),
}
GEOMETRIES = {
    "P": (NO_TURN, P),
    "R and P": (TURN, P),
    "R and P with a baseline": (TURN, STEREO_P),
    "P unset": (NO_TURN, np.zeros((3, 4))),
}
# x, y, height, width of the region of interest (zeros: all) and the binning.
WINDOWS = {
    "whole": ([0, 0, 0, 0], (1, 1)),
    "region": ([96, 48, 280, 420], (1, 1)),
    "binned": ([0, 0, 0, 0], (2, 2)),
    "region, binned": ([100, 40, 288, 432], (2, 4)),
}


def moved(camera, roi, binning):
    """A camera matrix of the whole sensor in the cut and averaged picture."""
    out = camera[:, :3].copy()
    for axis in (0, 1):
        out[axis, axis] /= binning[axis]
        out[axis, 2] = (out[axis, 2] + 0.5 - roi[axis]) / binning[axis] - 0.5
    return out


def opencv(image, model, d, r, p, roi, binning):
    """The rectified picture and where it sees."""
    raw, size = moved(K, roi, binning), image.shape[1::-1]
    rectified = moved(p if p.any() else K, roi, binning)
    make = cv2.fisheye.initUndistortRectifyMap if model == "equidistant" else cv2.initUndistortRectifyMap
    maps = make(raw, np.array(d), r, rectified, size, cv2.CV_32FC1)
    seen = cv2.remap(np.full(size[::-1], 255, np.uint8), *maps, cv2.INTER_LINEAR)
    return cv2.remap(image, *maps, cv2.INTER_LINEAR), seen == 255


def window(image, roi, binning):
    """Cut and averaged, in floats."""
    x, y, h, w = roi if any(roi) else (0, 0, HEIGHT, WIDTH)
    cut = image[y : y + h, x : x + w].astype(np.float64)
    bx, by = binning
    h, w = h // by, w // bx
    return cut[: h * by, : w * bx].reshape(h, by, w, bx, -1).mean((1, 3))


def main():
    program = sys.argv[1]
    image = picture(5)
    cases = {}
    with tempfile.TemporaryDirectory() as folder:
        for m, (model, d) in MODELS.items():
            for g, (r, p) in GEOMETRIES.items():
                for w, (roi, binning) in WINDOWS.items():
                    name = f"case{len(cases)}"
                    raw = np.rint(window(image, roi, binning)).astype(np.uint8)
                    height, width = raw.shape[:2]
                    case = {
                        "width": WIDTH, "height": HEIGHT, "model": model, "d": d, "k": K.ravel().tolist(),
                        "r": r.ravel().tolist(), "p": p.ravel().tolist(), "roi": roi, "already": False,
                        "binning_x": binning[0], "binning_y": binning[1], "out_width": width, "out_height": height,
                    }  # fmt: skip
                    Path(folder, name + ".json").write_text(json.dumps(case))
                    Path(folder, name + ".rgb").write_bytes(raw.tobytes())
                    cases[name] = (f"{m}, {g}, {w}", raw, (model, d, r, p, roi, binning))
        subprocess.run([program, folder], check=True)
        failed = 0
        for name, (label, raw, case) in cases.items():
            got = np.frombuffer(Path(folder, name + ".out").read_bytes(), np.uint8).reshape(raw.shape).astype(float)
            want, seen = opencv(raw, *case)
            # Ours is black where it sees nothing: beyond the fold of a lens, which OpenCV does not know.
            seen = cv2.erode((seen & got.any(-1)).astype(np.uint8), np.ones((2 * MARGIN + 1,) * 2), borderValue=0) == 1
            difference = np.abs(got - want)[seen]
            shifted = cv2.warpAffine(want, np.float64([[1, 0, 0.25], [0, 1, 0]]), want.shape[1::-1])
            mean, most, sharp = difference.mean(), difference.max(), np.abs(got - shifted)[seen].mean()
            good = mean < LIMIT and seen.mean() > 0.3 and sharp > LIMIT
            failed += not good
            print(
                f"{'ok  ' if good else 'FAIL'} {label}: mean {mean:.3f}, largest {most:.0f}, moved by a quarter pixel"
                f" {sharp:.2f}, {100 * seen.mean():.0f} % seen"
            )
    print(f"{len(cases)} cases, {failed} failed")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
