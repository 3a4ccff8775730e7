"""NYU, MSRA and ICVL: the layout each data set publishes, written small, must read back."""

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from handtrack.camera.readers import icvl, msra, nyu
from handtrack.camera.source import open_sequence
from handtrack.errors import DamagedFileError, InputError, MissingFileError


def hand_like(camera, z=600.0):
    """Depth in whole millimetres, a block in front of nothing."""
    depth = np.zeros(camera.shape)
    v, u = np.mgrid[40:90, 100:150]
    depth[40:90, 100:150] = np.round(z + 0.3 * u - 0.2 * v)
    return depth


@pytest.fixture
def nyu_folder(tmp_path):
    for number in (1, 2, 10):
        depth = (hand_like(nyu.CAMERA) + number).astype(np.uint16)
        colour = np.stack([depth & 255, depth >> 8, np.zeros_like(depth)], -1).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"depth_1_{number:07d}.png"), colour)  # blue, green, red
        cv2.imwrite(str(tmp_path / f"depth_2_{number:07d}.png"), colour * 0)
        cv2.imwrite(str(tmp_path / f"rgb_1_{number:07d}.png"), colour * 0)
    joints = np.random.default_rng(0).normal(size=(3, 10, 36, 3)) * 50 + [0, 0, 700]
    savemat(tmp_path / "joint_data.mat", {"joint_xyz": joints, "joint_uvd": joints * 0})
    return tmp_path, joints


def test_nyu_colours_become_metres_of_the_first_camera(nyu_folder):
    with open_sequence(nyu_folder[0]) as sequence:
        assert sequence.camera == nyu.CAMERA
        assert [frame.name[-11:-4] for frame in sequence] == ["0000001", "0000002", "0000010"]
        for frame, number in zip(sequence, (1, 2, 10), strict=True):
            expected = (hand_like(nyu.CAMERA) + number) / 1000
            np.testing.assert_allclose(frame.depth, expected, atol=1e-6)


def test_nyu_labels_follow_the_number_in_the_name_with_y_turned_down(nyu_folder):
    path, joints = nyu_folder
    with open_sequence(path) as sequence:
        truth = sequence[2].truth  # image number 10 is row 9
    assert truth is not None
    assert truth.joint_set == "nyu36"
    np.testing.assert_allclose(truth.joints, joints[0, 9] * [1e-3, -1e-3, 1e-3], atol=1e-6)


def test_nyu_projection_of_labels_agrees_with_the_authors(nyu_folder):
    # The data set's own conversion: u = x / z * 588.036865 + 320, v = 240 - y / z * 587.075073.
    path, joints = nyu_folder
    with open_sequence(path) as sequence:
        pixels = sequence.camera.project(sequence[0].truth.joints)
    x, y, z = joints[0, 0].T
    np.testing.assert_allclose(pixels[:, 0], x / z * 588.036865 + 320, atol=0.05)
    np.testing.assert_allclose(pixels[:, 1], 240 - y / z * 587.075073, atol=0.05)


def test_nyu_without_or_with_damaged_labels(nyu_folder):
    path, _ = nyu_folder
    (path / "joint_data.mat").write_bytes(b"MATLAB 5.0 but not really")
    with pytest.raises(DamagedFileError, match=r"joint_data\.mat"):
        open_sequence(path)
    savemat(path / "joint_data.mat", {"joint_xyz": np.zeros((3, 4, 5, 3))})
    with pytest.raises(DamagedFileError, match="36"):
        open_sequence(path)
    (path / "joint_data.mat").unlink()
    with open_sequence(path) as sequence:
        assert sequence.truth == frozenset()
        assert sequence[0].truth is None


def write_msra(folder, number, depth):
    rows, columns = np.nonzero(depth)
    top, bottom, left, right = rows.min(), rows.max() + 1, columns.min(), columns.max() + 1
    header = np.array([320, 240, left, top, right, bottom], "<u4")
    window = depth[top:bottom, left:right].astype("<f4")
    path = folder / f"{number:06d}_depth.bin"
    path.write_bytes(header.tobytes() + window.tobytes())
    return path


@pytest.fixture
def msra_folder(tmp_path):
    folder = tmp_path / "P0" / "TIP"
    folder.mkdir(parents=True)
    for number in range(3):
        write_msra(folder, number, hand_like(msra.CAMERA, 400.5 + number))
    joints = np.random.default_rng(0).normal(size=(3, 21, 3)) * 40 + [0, 0, -400]
    lines = [" ".join(f"{value:.4f}" for value in frame.ravel()) for frame in joints]
    (folder / "joint.txt").write_text("\n".join(["3", *lines]) + "\n")
    return folder, joints


def test_msra_window_is_put_back_in_its_place(msra_folder):
    with open_sequence(msra_folder[0]) as sequence:
        assert sequence.camera == msra.CAMERA
        assert sequence.name == "P0_TIP"
        assert sequence.subject is not None
        assert sequence.subject.side == "right"
        for number, frame in enumerate(sequence):
            expected = hand_like(msra.CAMERA, 400.5 + number) / 1000
            np.testing.assert_allclose(frame.depth, expected, atol=1e-6)


def test_msra_labels_have_y_up_z_backward_and_the_thumb_last(msra_folder):
    path, joints = msra_folder
    with open_sequence(path) as sequence:
        truth = sequence[1].truth
    assert truth is not None
    ours = joints[1] * [1e-3, -1e-3, -1e-3]
    assert (ours[:, 2] > 0).all()
    np.testing.assert_allclose(truth.joints, ours, atol=1e-6)
    np.testing.assert_allclose(truth.keypoints[0], ours[0], atol=1e-6)  # wrist
    np.testing.assert_allclose(truth.keypoints[1:5], ours[17:21], atol=1e-6)  # thumb
    np.testing.assert_allclose(truth.keypoints[5:], ours[1:17], atol=1e-6)  # index to little


def test_msra_single_file(msra_folder):
    with open_sequence(msra_folder[0] / "000002_depth.bin") as sequence:
        assert len(sequence) == 1
        assert sequence[0].truth is not None  # row 2 of the folder's labels


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda data: data[:10], "header"),
        (lambda data: data[:-4], "bytes"),
        (lambda data: data + b"1234", "bytes"),
        (lambda data: b"\xff" * 24 + data[24:], "impossible"),
        (lambda data: b"", "truncated"),
    ],
)
def test_msra_damage_is_named_and_does_not_stop_the_sequence(msra_folder, change, words):
    file = msra_folder[0] / "000001_depth.bin"
    file.write_bytes(change(file.read_bytes()))
    with open_sequence(msra_folder[0]) as sequence:
        frames = list(sequence)
        with pytest.raises(DamagedFileError, match=words):
            sequence.read(1)
    assert [frame.problem is None for frame in frames] == [True, False, True]
    assert "000001_depth.bin" in (frames[1].problem or "")


@pytest.mark.parametrize("text", ["", "x", "3\n1 2 3", "-1\n"])
def test_msra_damaged_labels_are_named(msra_folder, text):
    (msra_folder[0] / "joint.txt").write_text(text)
    with pytest.raises(DamagedFileError, match=r"joint\.txt"):
        open_sequence(msra_folder[0])


def uvd_line(name, values):
    return name + " " + " ".join(f"{value:.3f}" for value in values.ravel()) + " "


@pytest.fixture
def icvl_root(tmp_path):
    folder = tmp_path / "Depth" / "test_seq_1"
    folder.mkdir(parents=True)
    uvd = np.random.default_rng(0).uniform([100, 80, 300], [200, 160, 400], (3, 16, 3))
    lines = []
    for number in range(3):
        depth = (hand_like(icvl.CAMERA, 350) + number).astype(np.uint16)
        depth[0] = 32001  # farther than any measurement
        cv2.imwrite(str(folder / f"image_{number:04d}.png"), depth)
        lines.append(uvd_line(f"test_seq_1/image_{number:04d}.png", uvd[number]))
    (tmp_path / "test_seq_1.txt").write_text("\n".join(lines) + "\n\n")
    return tmp_path, uvd


@pytest.mark.parametrize("place", ["test_seq_1.txt", "Depth/test_seq_1", "."])
def test_icvl_by_labels_by_images_or_by_root(icvl_root, place):
    root, uvd = icvl_root
    with open_sequence(root / place) as sequence:
        assert sequence.camera == icvl.CAMERA
        assert sequence.name == "test_seq_1"
        assert len(sequence) == 3
        for number, frame in enumerate(sequence):
            expected = hand_like(icvl.CAMERA, 350) + number
            expected[0] = 0
            np.testing.assert_allclose(frame.depth, expected / 1000, atol=1e-6)
            assert frame.truth is not None
            assert frame.truth.joint_set == "icvl16"
            joints = frame.truth.joints
            np.testing.assert_allclose(joints[:, 2], uvd[number, :, 2] / 1000, atol=1e-5)
            pixels = sequence.camera.project(joints)
            np.testing.assert_allclose(pixels, uvd[number, :, :2], atol=2e-3)


def test_icvl_images_without_labels(icvl_root):
    root, _ = icvl_root
    (root / "test_seq_1.txt").unlink()
    with open_sequence(root / "Depth" / "test_seq_1") as sequence:
        assert sequence[0].truth is None
        assert sequence.truth == frozenset()
    with pytest.raises(MissingFileError, match="no label file") as caught:
        for folder in list((root / "Depth").iterdir()):
            folder.rename(root / folder.name)
        open_sequence(root)
    assert str(root) in str(caught.value)


def test_icvl_root_with_several_sequences_asks_for_one(icvl_root):
    root, _ = icvl_root
    (root / "test_seq_2.txt").write_text((root / "test_seq_1.txt").read_text())
    with pytest.raises(InputError, match="test_seq_2"):
        open_sequence(root)


def test_icvl_damaged_labels_are_named_with_their_line(icvl_root):
    root, _ = icvl_root
    text = (root / "test_seq_1.txt").read_text().splitlines()
    text[1] = text[1][:100]
    (root / "test_seq_1.txt").write_text("\n".join(text))
    with pytest.raises(DamagedFileError, match="line 2"):
        open_sequence(root / "test_seq_1.txt")


def test_icvl_listed_image_that_is_missing_is_flagged(icvl_root):
    root, _ = icvl_root
    (root / "Depth" / "test_seq_1" / "image_0001.png").unlink()
    with open_sequence(root / "test_seq_1.txt") as sequence:
        assert [frame.problem is None for frame in sequence] == [True, False, True]


@pytest.mark.parametrize("name", ["npz", "nyu", "msra", "icvl", "png"])
def test_a_format_forced_on_an_empty_folder_says_what_it_expects(tmp_path, name):
    with pytest.raises(MissingFileError, match="holds no"):
        open_sequence(tmp_path, format=name)
