import numpy as np
from scipy import ndimage

from fluoromap.segmenter.picture.motion_meter import MotionMeter


def test_motion_is_seen_through_photon_noise():
    rng = np.random.default_rng(4)
    still = np.zeros((128, 128))
    still[60:66, 60:66] = -0.9
    frames = [ndimage.shift(still, (0, shift), order=1) for shift in (0, 0, 0, 3, 6, 6, 6)]
    frames = [(frame + rng.normal(0, 0.12, frame.shape)).astype(np.float32) for frame in frames]
    meter = MotionMeter(frames, np.ones((128, 128), bool))
    motion = [meter(frame) for frame in frames]
    assert motion[0] == 0
    assert min(motion[3], motion[4]) > 1.5 * max(motion[1], motion[2], motion[5], motion[6])
