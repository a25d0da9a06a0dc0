"""Detection, tracking and SAM 3 in their workers, with tiny random checkpoints."""

import json

import numpy as np
import pytest
import torch
from PIL import Image

from egosim_jax.perception.networks.grounded import GroundedSam2, GroundedSam3
from egosim_jax.perception.networks.grounding_dino import GroundingDino, groups, phrase_scores
from egosim_jax.perception.networks.pixels import PixelSettings, resize_levels, to_images
from egosim_jax.perception.networks.sam3 import MaskTools, Sam3
from egosim_jax.perception.networks.tracking import EdgeTam, Sam2Tracker, Sam3Tracker
from egosim_jax.perception.networks.worker import close_workers
from egosim_jax.perception.video.estimates import HandTracks, Segmenter
from egosim_jax.types import InputError
from tests.unit.perception.networks import tiny

pytestmark = pytest.mark.slow
HEIGHT, WIDTH = 48, 80
FRAMES = np.random.default_rng(0).integers(0, 256, (4, HEIGHT, WIDTH, 3)).astype(np.uint8)
BOXES = [(5.0, 5.0, 30.0, 40.0), (30.0, 8.0, 75.0, 44.0)]


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """Return a function that makes each named checkpoint once."""
    made = {}

    def make(name):
        if name not in made:
            made[name] = getattr(tiny, name)(tmp_path_factory.mktemp(name))
        return made[name]

    yield make
    close_workers()


def test_boxes_and_scores_are_those_of_transformers_own_processor(folders):
    import transformers as hf

    folder = folders("grounding_dino")
    phrases = ["red cup", "book", "hand"]
    network = hf.GroundingDinoForObjectDetection.from_pretrained(folder).eval()
    images = hf.GroundingDinoImageProcessorPil.from_pretrained(folder)
    tokenizer = hf.BertTokenizer.from_pretrained(folder)
    processor = hf.GroundingDinoProcessor(images, tokenizer)
    inputs = processor(images=FRAMES[0], text="red cup. book. hand.", return_tensors="pt")
    with torch.inference_mode():
        output = network(**inputs)
    want = processor.post_process_grounded_object_detection(
        output, inputs["input_ids"], threshold=0.0, target_sizes=[(HEIGHT, WIDTH)]
    )[0]
    text = tokenizer.convert_ids_to_tokens(inputs["input_ids"][0])
    assert text == ["[CLS]", "red", "cup", ".", "book", ".", "hand", ".", "[SEP]"]
    tokens = output.logits[0].sigmoid().numpy()
    scores = np.stack([tokens[:, [1, 2]].max(axis=1), tokens[:, 4], tokens[:, 6]], axis=1)

    found, _ = GroundingDino(folder).ask({"frames": FRAMES[:1]}, phrases=phrases)

    np.testing.assert_allclose(found["boxes_px"][0], want["boxes"].numpy(), atol=2e-3)
    np.testing.assert_allclose(found["scores"][0], scores, atol=1e-5)


def test_detections_are_sorted_bounded_and_of_their_phrases(folders):
    detector = GroundingDino(folders("grounding_dino"), threshold=0.0, max_overlap=0.3)
    for frame in detector(FRAMES, [f"Red cup {k % 17}." for k in range(20)] + ["hand"]):
        assert frame
        scores = [one.score for one in frame]
        assert scores == sorted(scores, reverse=True)
        assert {one.phrase for one in frame} <= {f"red cup {k}" for k in range(17)} | {"hand"}
    assert not any(GroundingDino(folders("grounding_dino"), threshold=1.0)(FRAMES, ["book"]))
    with pytest.raises(InputError, match="at least one phrase"):
        detector(FRAMES, [" . "])


def test_phrases_are_grouped_by_the_length_of_their_text():
    phrases = ["a b", "c", "d e f", "g", "h i j k l"]
    found = list(groups(phrases, lambda phrase: len(phrase.split()), 9))
    assert found == [["a b", "c"], ["d e f", "g"], ["h i j k l"]]


def test_a_phrase_has_the_largest_score_of_its_tokens():
    tokens = torch.tensor([[0.9, 0.1, 0.3, 0.8, 0.2, 0.7, 0.6]])
    text = torch.tensor([101, 5, 6, 1012, 7, 1012, 102])
    np.testing.assert_allclose(phrase_scores(tokens, text, 1012).numpy(), [[0.3, 0.2]])


@pytest.mark.parametrize(
    ("name", "kind"),
    [("edgetam", EdgeTam), ("sam2", Sam2Tracker), ("sam3", Sam3Tracker)],
)
def test_a_tracker_labels_every_frame_as_its_network_does(folders, name, kind):
    labels = kind(folders(name))(FRAMES, 1, BOXES)
    assert labels.shape == FRAMES.shape[:3]
    assert set(np.unique(labels)) <= {0, 1, 2}
    want = labels_of(name, folders(name))
    assert want.any()
    assert (labels == want).mean() > 0.999


def labels_of(name, folder):
    """Return the network's labels for inputs from independent formulas."""
    import transformers as hf
    from torch.nn.functional import interpolate

    kind = {"edgetam": "EdgeTamVideo", "sam2": "Sam2Video", "sam3": "Sam3TrackerVideo"}[name]
    network = getattr(hf, f"{kind}Model").from_pretrained(folder).eval()
    settings = json.loads((folder / "video_preprocessor_config.json").read_text())
    size = settings["size"]["height"]
    pixels = resize_levels(torch.from_numpy(FRAMES).permute(0, 3, 1, 2).float(), (size, size))
    mean, std = (torch.tensor(settings[f"image_{k}"])[:, None, None] for k in ("mean", "std"))
    module = __import__(type(network).__module__, fromlist=["x"])
    session = getattr(module, f"{kind}InferenceSession")(
        video=(pixels / 255 - mean) / std, video_height=HEIGHT, video_width=WIDTH,
        dtype=torch.float32,
    )  # fmt: skip
    for number, (left, top, right, bottom) in enumerate(BOXES, start=1):
        corners = torch.tensor([[left / WIDTH, top / HEIGHT], [right / WIDTH, bottom / HEIGHT]])
        points = {
            "point_coords": (corners * size).reshape(1, 1, 2, 2),
            "point_labels": torch.tensor([[[2, 3]]], dtype=torch.int32),
        }
        session.add_point_inputs(session.obj_id_to_idx(number), 1, points)
        session.obj_with_new_inputs.append(number)
    labels = np.zeros(FRAMES.shape[:3], np.int32)
    with torch.inference_mode():
        for reverse in (False, True):
            for output in network.propagate_in_video_iterator(
                session, start_frame_idx=1, reverse=reverse
            ):
                masks = interpolate(output.pred_masks, (HEIGHT, WIDTH), mode="bilinear")[:, 0]
                best = torch.where(masks[1] > masks[0], 2, 1)
                labels[output.frame_idx] = torch.where(masks.amax(dim=0) > 0, best, 0).numpy()
    return labels


def test_frames_are_resized_as_by_an_image_library():
    settings = PixelSettings(height=30, width=50, mean=(0.5,) * 3, std=(0.5,) * 3)
    found = resize_levels(to_images(FRAMES[:1], "cpu"), (settings.height, settings.width))
    want = Image.fromarray(FRAMES[0]).resize((50, 30), Image.Resampling.BILINEAR)
    gaps = np.abs(found[0].permute(1, 2, 0).numpy() - np.asarray(want, float))
    assert gaps.max() <= 1


def test_the_processors_file_of_a_checkpoint_decides_over_the_default(tmp_path):
    default = PixelSettings(height=10, width=10, mean=(0.5,) * 3, std=(0.5,) * 3)
    assert PixelSettings.read(tmp_path, default) == default
    part = {"size": {"height": 20, "width": 30}, "image_mean": [0.1, 0.2, 0.3]}
    (tmp_path / "processor_config.json").write_text(json.dumps({"video_processor": part}))
    found = PixelSettings.read(tmp_path, default)
    assert (found.height, found.width, found.mean, found.std) == (
        20,
        30,
        (0.1, 0.2, 0.3),
        (0.5,) * 3,
    )
    for wrong in ({"size": {"height": 9999, "width": 1}}, {"image_std": [0, 1, 1]}):
        (tmp_path / "preprocessor_config.json").write_text(json.dumps(wrong))
        with pytest.raises(InputError, match=r"image processor|image_std"):
            PixelSettings.read(tmp_path, default)


def test_sam3_names_what_it_follows(folders):
    segmenter = Sam3(folders("sam3"))
    assert isinstance(segmenter, Segmenter)
    ids, names = segmenter(FRAMES[:3], ["cup", "hand"])
    assert ids.shape == FRAMES[:3].shape[:3]
    assert ids.any()
    assert set(np.unique(ids)) - {0} <= set(names)
    for number, name in names.items():
        assert name == ("hand" if number < 0 else "cup")


def test_a_detector_and_a_tracker_are_one_segmenter(folders):
    segmenter = GroundedSam3(folders("grounding_dino"), folders("sam3"), threshold=0.0, every=2)
    assert isinstance(segmenter, Segmenter)
    joints = np.full((4, 2, 21, 2), np.nan)
    joints[:, 1] = np.random.default_rng(0).uniform((40, 20), (60, 35), (4, 21, 2))
    hands = HandTracks(
        joints_px=joints, joints_hand_m=np.zeros((4, 2, 21, 3)), presence=np.full((4, 2), 0.9)
    )
    ids, names = segmenter(FRAMES, ["red cup", "book"], hands)
    assert ids.shape == FRAMES.shape[:3]
    assert set(np.unique(ids)) - {0} <= set(names)
    assert names[-1] == "hand"
    assert set(names.values()) <= {"hand", "red cup", "book"}


def test_wrong_folders_are_refused_before_anything_runs(folders):
    with pytest.raises(InputError, match=r"'sam2_video': SAM 3 .* needs sam3_video"):
        GroundedSam3(folders("grounding_dino"), folders("sam2"))
    with pytest.raises(InputError, match=r"Grounding DINO .* needs grounding-dino"):
        GroundedSam2(folders("sam2"), folders("sam2"))


def test_an_encoder_of_another_library_is_named(folders, monkeypatch):
    network = EdgeTam(folders("edgetam"))
    monkeypatch.setattr(
        EdgeTam,
        "_read_config",
        lambda self: {"vision_config": {"backbone_config": {"model_type": "timm_wrapper"}}},
    )
    with pytest.raises(InputError, match=r"timm must be installed"):
        network.check_installed()


def test_duplicates_are_suppressed_by_score():
    ious = torch.tensor([[1.0, 0.9, 0.0], [0.9, 1.0, 0.05], [0.0, 0.05, 1.0]])
    kept = MaskTools.generic_nms(ious, torch.tensor([0.5, 0.8, 0.1]), 0.1, use_iou_matrix=True)
    assert kept.tolist() == [1, 2]


def test_components_have_their_areas():
    masks = torch.zeros((1, 1, 5, 6), dtype=torch.uint8)
    masks[0, 0, :2, :2], masks[0, 0, 4, 5] = 1, 1
    labels, areas = MaskTools.cc_2d(masks, get_counts=True)
    assert labels.dtype == areas.dtype == torch.int32
    assert areas[0, 0, 0, 0] == areas[0, 0, 1, 1] == 4
    assert areas[0, 0, 4, 5] == 1
    assert areas.sum() == 17
    assert labels.unique().tolist() == [0, 1, 2]
