import cv2
import numpy as np
import pytest

from mdnvo_jax.config import ImageConfig
from mdnvo_jax.data import images
from mdnvo_jax.errors import InputError

KITTI = (718.856, 718.856, 607.1928, 185.2157)


def see(camera, size, directions, spread):
    """Return what a camera sees of smooth blobs at `directions` (x / z, y / z): Gaussians of deviation `spread`."""
    fx, fy, cx, cy = camera
    v, u = np.mgrid[: size[0], : size[1]]
    light = np.zeros(size)
    for x, y in directions:
        light += np.exp(-((((u - cx) / fx - x) ** 2 + ((v - cy) / fy - y) ** 2) / (2 * spread**2)))
    return np.rint(20 + 220 * light.clip(0, 1)).astype(np.uint8)[..., None]


def centroid(image, at, radius):
    """Return where (u, v) the light above the background is centred around `at`."""
    u0, v0 = (round(value) for value in at)
    window = image[v0 - radius : v0 + radius + 1, u0 - radius : u0 + radius + 1, 0].astype(float) - 20
    v, u = np.mgrid[v0 - radius : v0 + radius + 1, u0 - radius : u0 + radius + 1]
    return (u * window).sum() / window.sum(), (v * window).sum() / window.sum()


GRID = [(x, y) for x in (-0.6, -0.31, 0.007, 0.29, 0.62) for y in (-0.1, 0.09)]


@pytest.mark.parametrize(
    ("source", "size", "virtual", "target"),
    [
        # KITTI to its own camera, scaled; then the other KITTI camera to it; a phone; 1:1.5; about 1:1; enlarged.
        (KITTI, (376, 1241), images.scaled_camera(KITTI, (376, 1241), (184, 608)), (184, 608)),
        ((707.0912, 707.0912, 601.8873, 183.1104), (370, 1226), (352.2, 351.8, 297.2, 90.4), (184, 608)),
        (KITTI, (376, 1241), images.scaled_camera(KITTI, (376, 1241), (80, 256)), (80, 256)),
        ((1400.0, 1410.0, 955.3, 547.1), (1080, 1920), (195.3, 200.1, 125.1, 39.0), (80, 256)),
        ((533.1, 533.1, 470.2, 190.7), (376, 940), (352.2, 351.8, 297.2, 90.4), (184, 608)),
        ((360.3, 359.8, 300.9, 95.7), (190, 610), (352.2, 351.8, 297.2, 90.4), (184, 608)),
        ((250.0, 250.0, 211.3, 80.4), (160, 430), (352.2, 351.8, 297.2, 90.4), (184, 608)),
    ],
)
def test_a_direction_lands_where_the_virtual_camera_sees_it(source, size, virtual, target):
    spread = 6.0 / virtual[0]
    config = ImageConfig(height=target[0], width=target[1], channels=1, camera=virtual)
    directions = [(x, y) for x, y in GRID if abs(virtual[0] * x) + 24 < min(virtual[2], target[1] - virtual[2])]
    directions = directions[::2] if target[0] == 80 else directions  # blobs of one column would touch
    prepared = images.prepare(see(source, size, directions, spread), source, config)
    expected = see(virtual, target, directions, spread)
    assert prepared.shape == (*target, 1) and prepared.dtype == np.uint8
    inside = np.s_[4:-4, 4:-4]
    assert np.abs(prepared[inside].astype(int) - expected[inside]).max() <= 6
    assert len(directions) >= 3
    for x, y in directions:
        at = (virtual[0] * x + virtual[2], virtual[1] * y + virtual[3])
        if min(at[1], target[0] - 1 - at[1]) > 18:
            np.testing.assert_allclose(centroid(prepared, at, 17), centroid(expected, at, 17), atol=0.05)


def test_without_a_camera_the_whole_frame_is_resized():
    """A frame of unknown camera, rectification off, and no virtual camera all mean the same pixels."""
    rng = np.random.default_rng(0)
    frame = cv2.GaussianBlur(rng.integers(0, 256, (376, 1241, 3), dtype=np.uint8), (0, 0), 4)
    config = ImageConfig(height=184, width=608, camera=(100.0, 100.0, 300.0, 90.0))
    whole = images.prepare(frame, None, config)
    np.testing.assert_array_equal(whole, images.prepare(frame, KITTI, ImageConfig(height=184, width=608)))
    unrectified = ImageConfig(height=184, width=608, camera=config.camera, rectify=False)
    np.testing.assert_array_equal(whole, images.prepare(frame, KITTI, unrectified))
    # OpenCV's own area averaging is the reference; it differs only in how it weights the edge of a pixel's footprint.
    reference = cv2.resize(frame, (608, 184), interpolation=cv2.INTER_AREA)
    assert np.abs(whole.astype(int) - reference).max() <= 2


def test_scaled_camera_is_what_the_whole_frame_resize_does():
    scaled = images.scaled_camera(KITTI, (376, 1241), (184, 608))
    frame = see(KITTI, (376, 1241), GRID, 0.02)
    with_camera = images.prepare(frame, KITTI, ImageConfig(height=184, width=608, channels=1, camera=scaled))
    without = images.prepare(frame, None, ImageConfig(height=184, width=608, channels=1))
    np.testing.assert_allclose(with_camera.astype(int), without.astype(int), atol=1)
    np.testing.assert_allclose(scaled, (352.1873, 351.7806, 297.2254, 90.3822), atol=1e-3)


@pytest.mark.parametrize("size", [(80, 256), (184, 608), (100, 333)])
def test_detail_that_is_too_fine_averages_out(size):
    """A chessboard of single pixels has no place in a picture of half the size: it must not alias into stripes."""
    board = (255 * (np.indices((376, 1241)).sum(0) % 2)).astype(np.uint8)[..., None]
    small = images.prepare(board, None, ImageConfig(height=size[0], width=size[1], channels=1))
    assert np.abs(small[2:-2, 2:-2].astype(int) - 127.5).max() < 20
    stripes = np.zeros((376, 1241, 1), np.uint8)
    stripes[:, ::2] = 255
    small = images.prepare(stripes, None, ImageConfig(height=size[0], width=size[1], channels=1))
    # What remains of stripes at an odd ratio is what averaging over the footprint of a pixel leaves, and little more.
    reference = cv2.resize(stripes, (size[1], size[0]), interpolation=cv2.INTER_AREA)
    assert small[2:-2, 2:-2].std() < reference[2:-2, 2:-2].std() + 8


def test_a_prepared_frame_is_left_alone():
    config = ImageConfig(height=184, width=608, channels=3, camera=(352.2, 351.8, 297.2, 90.4))
    frame = np.random.default_rng(1).integers(0, 256, (184, 608, 3), dtype=np.uint8)
    assert images.prepare(frame, config.camera, config) is frame
    assert images.prepare(frame, None, config) is frame
    assert images.prepare(frame, (352.2, 351.8, 297.7, 90.4), config) is not frame


def test_uncovered_counts_what_the_virtual_camera_sees_past_the_edge():
    config = ImageConfig(height=100, width=200, channels=1, camera=(100.0, 100.0, 99.5, 49.5))
    assert images.uncovered((100, 200), (100.0, 100.0, 99.5, 49.5), config) == 0
    assert images.uncovered((376, 1241), None, config) == 0
    # Twice the focal length: the frame shows the middle half of the width, and half of the height.
    assert images.uncovered((100, 200), (200.0, 200.0, 99.5, 49.5), config) == pytest.approx(0.75)
    # The principal point 20 columns further left: 20 columns on the left see nothing.
    assert images.uncovered((100, 200), (100.0, 100.0, 79.5, 49.5), config) == pytest.approx(0.1)


def test_past_the_edge_the_edge_is_repeated():
    config = ImageConfig(height=20, width=40, channels=1, camera=(10.0, 10.0, 29.5, 9.5))
    frame = np.full((20, 40, 1), 90, np.uint8)
    frame[:, 0] = 10
    prepared = images.prepare(frame, (10.0, 10.0, 19.5, 9.5), config)
    assert (prepared[:, :11] == 10).all() and (prepared[:, 11:] == 90).all()


def test_prepare_converts_channels():
    colour = np.zeros((20, 40, 3), np.uint8)
    colour[..., 0] = 200  # red
    grey = images.prepare(colour, None, ImageConfig(height=20, width=40, channels=1))
    assert grey.shape == (20, 40, 1) and (grey == 60).all()  # ITU-R BT.601: 0.299 of red
    back = images.prepare(grey[..., 0], None, ImageConfig(height=20, width=40, channels=3))
    assert back.shape == (20, 40, 3) and (back == 60).all()
    for wrong in (np.zeros((4, 4, 4), np.uint8), np.zeros((4, 4, 3), np.float32), np.zeros((0, 4, 3), np.uint8)):
        with pytest.raises(InputError, match=r"expected uint8"):
            images.prepare(wrong, None, ImageConfig())


# Reading


@pytest.fixture
def colour():
    rng = np.random.default_rng(2)
    return cv2.GaussianBlur(rng.integers(0, 256, (24, 32, 3), dtype=np.uint8), (0, 0), 2)


@pytest.mark.parametrize("suffix", ["png", "tiff", "bmp", "ppm"])
def test_read_image_gives_rgb_and_grey(tmp_path, colour, suffix):
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), colour[..., ::-1])
    np.testing.assert_array_equal(images.read_image(path, 3), colour)
    grey = images.read_image(path, 1)
    assert grey.shape == (24, 32, 1)
    np.testing.assert_allclose(grey[..., 0].astype(float), colour @ [0.299, 0.587, 0.114], atol=1)


@pytest.mark.parametrize("suffix", ["jpg", "webp"])
def test_read_image_of_lossy_files(tmp_path, colour, suffix):
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), colour[..., ::-1])
    assert np.abs(images.read_image(path, 3).astype(int) - colour).mean() < 6
    assert images.read_image(path, 1).shape == (24, 32, 1)


def test_read_image_of_grey_files(tmp_path, colour):
    cv2.imwrite(str(tmp_path / "a.png"), colour[..., 0])
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.png", 3), colour[..., [0, 0, 0]])
    np.testing.assert_array_equal(images.read_image(tmp_path / "a.png", 1), colour[..., :1])


@pytest.mark.parametrize("suffix", ["png", "tiff"])
def test_read_image_scales_sixteen_bits_and_drops_alpha(tmp_path, colour, suffix):
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), colour[..., ::-1].astype(np.uint16) * 257)
    np.testing.assert_array_equal(images.read_image(path, 3), colour)
    cv2.imwrite(str(path), colour[..., 0].astype(np.uint16) * 257 + 100)
    np.testing.assert_array_equal(images.read_image(path, 1), colour[..., :1])
    cv2.imwrite(str(path), np.full((4, 4), 65535, np.uint16))
    assert (images.read_image(path, 1) == 255).all()
    alpha = np.full((24, 32, 1), 0, np.uint8)
    cv2.imwrite(str(path), np.concatenate([colour[..., ::-1], alpha], -1))
    np.testing.assert_array_equal(images.read_image(path, 3), colour)


def test_read_image_applies_the_rotation_in_exif(tmp_path):
    frame = np.zeros((16, 48, 3), np.uint8)
    frame[:, :24] = 200
    data = cv2.imencode(".jpg", frame)[1].tobytes()
    # One entry: tag 0x0112 (orientation), type 3 (short), value 6: turn right by 90 degrees to view.
    exif = b"Exif\0\0MM\0*\0\0\0\x08" + b"\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    path = tmp_path / "a.jpg"
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:])
    turned = images.read_image(path, 3)
    assert turned.shape == (48, 16, 3)
    assert turned[:20].min() > 150 and turned[28:].max() < 50


@pytest.mark.parametrize("suffix", ["png", "jpg", "webp"])
@pytest.mark.parametrize("share", [0.3, 0.9])
def test_read_image_refuses_a_file_that_is_cut_short(tmp_path, colour, suffix, share):
    path = tmp_path / f"a.{suffix}"
    cv2.imwrite(str(path), np.tile(colour, (4, 4, 1)))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(InputError, match=rf"a\.{suffix} (is cut short|cannot be decoded)"):
        images.read_image(path, 3)


def test_read_image_of_a_jpeg_with_a_trailer_and_a_thumbnail(tmp_path, colour):
    """Phones append data after the end marker, and hold a whole JPEG, end marker included, in a segment."""
    data = cv2.imencode(".jpg", colour)[1].tobytes()
    segment = b"\xff\xe2" + (len(data) + 2).to_bytes(2, "big") + data
    whole = data[:2] + segment + data[2:]
    path = tmp_path / "a.jpg"
    path.write_bytes(whole + b"trailer" * 9)
    assert images.read_image(path, 3).shape == (24, 32, 3)
    path.write_bytes(whole[:-40])
    with pytest.raises(InputError, match=r"cut short"):
        images.read_image(path, 3)


def test_read_image_refuses_what_is_no_picture(tmp_path):
    path = tmp_path / "a.png"
    with pytest.raises(InputError, match=r"cannot read .*a\.png \(No such file"):
        images.read_image(path, 3)
    for content in (b"", b"hello", b"\xff\xd8\xff", b"\x89PNG"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"a\.png"):
            images.read_image(path, 3)
    cv2.imwrite(str(tmp_path / "a.tiff"), np.zeros((4, 4), np.float32))
    with pytest.raises(InputError, match=r"a\.tiff has samples of type float32"):
        images.read_image(tmp_path / "a.tiff", 1)
