"""No stored value is compared by nothing: the comparisons are run again, and what they read is noted.

Here and not at the end of the other tests: those run in several processes, and in any selection.
"""

from pathlib import Path

import pytest
from safetensors.torch import load_file

from tests.models import golden_folder
from tests.models import test_policy_steps as steps
from tests.models.golden_values import GoldenValues
from tests.models.octo import test_octo_parity as octo
from tests.models.octo import test_octo_policy as octo_policy
from tests.models.octo import test_octo_whole_path as octo_whole_path
from tests.models.octo.tiny_octo import GOLDEN
from tests.models.openvla import openvla_golden
from tests.models.openvla import test_openvla_convert as openvla_convert
from tests.models.openvla import test_openvla_network as openvla_network
from tests.models.openvla import test_openvla_paper_compat as openvla_paper_compat
from tests.models.openvla import test_openvla_policy as openvla_policy
from tests.models.openvla import test_openvla_tokens as openvla_tokens
from tests.models.openvla import test_openvla_whole_path as openvla_whole_path
from tests.models.sequence import test_sequence_parity as sequence
from tests.models.spatialvla import spatialvla_golden
from tests.models.spatialvla import test_spatialvla_network as network
from tests.models.spatialvla import test_spatialvla_policy as policy
from tests.models.spatialvla import test_spatialvla_tokens as tokens

OF_CONVERSION = {"unnorm.ids", "unnorm.actions"}  # read in test_spatialvla_convert, from a converted folder
# Of robots with fewer dimensions, whose other ones the original fills with noise: ours fill all.
NOT_IMPLEMENTED = "sample.w2_ead5."


def test_every_value_of_octo_is_compared() -> None:
    io = GoldenValues(GOLDEN / "io.safetensors")
    weights = load_file(GOLDEN / "weights.safetensors")
    made = octo.make_network(weights)
    forward, diffusion, windows = octo.TestForward(), octo.TestDiffusion(), octo_policy.TestWindows()
    for case in octo.CONFIG["cases"]:
        forward.test_tokens_readouts_and_noise_are_those_of_the_original(io, made, case)
    forward.test_image_tokens_are_those_of_the_original(io, made)
    forward.test_the_text_encoder_of_transformers_is_that_of_the_original(io, weights)
    diffusion.test_the_schedule_is_that_of_the_original(io)
    for case in ("w1", "wmax_padhist"):
        diffusion.test_sampling_from_the_same_noise_gives_the_same_chunk(io, made, case)
    for case in ("w1", "wmax_pad_wristmask"):
        diffusion.test_loss_and_gradients_are_those_of_the_original(io, made, case, case)
    for name in ("chunk_full", "chunk_w2"):
        windows.test_training_targets_are_the_originals_where_they_count(io, name)
    windows.test_history_in_an_episode_is_that_of_the_originals_wrapper(io)
    steps.TestNormalizer().test_mean_std_with_a_mask_is_that_of_the_original(io)
    for name in ("resize_down", "resize_up", "resize_down_rect"):
        steps.TestImages().test_resizing_is_tensorflows_to_a_level(io, name)
    steps.TestImages().test_resize_and_centre_crop_are_those_of_the_originals_evaluation(io)
    for decay in (0.0, 0.5):
        octo_whole_path.test_an_ensemble_of_chunks_executes_the_originals_means(io, decay)
    octo_whole_path.test_receding_horizon_executes_and_shows_what_the_originals_wrapper_does(io)
    assert {key for key in io.unread() if not key.startswith(NOT_IMPLEMENTED)} == set()


def test_every_value_of_spatialvla_is_compared() -> None:
    golden_folder.stored_values.cache_clear()
    vision, inference, training = network.TestVision(), network.TestInference(), network.TestTraining()
    vision.test_the_depth_model_is_shown_padded_images()
    for camera in ("default", "mikasa"):
        vision.test_points_in_space_position_encoding_and_features(camera)
    vision.test_every_image_has_a_camera_of_its_own()
    vision.test_siglips_last_state()
    for index in range(network.N_PROMPTS):
        inference.test_logits_tokens_and_actions(index)
    inference.test_two_images()
    for name, images in network.TRAININGS:
        for regime, attention in network.REGIMES:
            training.test_logits_loss_and_gradients_of_a_padded_batch(name, images, regime, attention)
    for name, prefix in tokens.GRIDS:
        tokens.TestGrid().test_edges_are_the_originals(name, prefix)
    for name in ("uniform", "gaussian"):
        tokens.TestTokens().test_there_back_and_there_again_are_the_originals(name)
    tokens.TestTokens().test_every_token_in_every_column_is_decoded_as_the_original_does()
    tokens.TestRefit().test_the_original_interpolates_between_the_same_middles_but_takes_roll_for_pitch()
    policy.TestImages().test_the_originals_are_the_same()
    steps.TestNormalizer().test_q01_q99_is_that_of_the_original_and_back_what_was_not_cut()
    assert spatialvla_golden.values().unread() == OF_CONVERSION


@pytest.mark.slow  # the comparisons themselves are in every run
def test_every_value_of_openvla_is_compared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    golden_folder.stored_values.cache_clear()
    published = tmp_path / "published"
    published.mkdir()
    openvla_golden.write_published(published)
    inference, training = openvla_network.TestInference(), openvla_network.TestTraining()
    for n_cameras in (1, 2):
        inference.test_features_and_tokens_of_the_images(n_cameras)
    inference.test_the_images_are_normalised_for_either_eye()
    inference.test_a_raw_image_is_resized_and_normalised_as_by_the_originals_processor()
    for case in openvla_network.CASES:
        inference.test_hidden_states_and_actions(*case)
    for name, n_cameras, proprio in openvla_network.TRAININGS:
        training.test_loss_and_gradients_of_a_padded_batch(name, n_cameras, proprio)
    training.test_the_sequence_of_a_padded_batch_is_the_originals()
    openvla_tokens.test_decoding_all_at_once_is_the_originals()
    openvla_policy.TestNormalization().test_actions_and_state_are_normalised_as_in_the_originals_training()
    openvla_paper_compat.test_images_go_through_jpeg_of_quality_95()
    actions = openvla_convert.test_normalised_numbers_become_the_originals_actions_and_the_gripper_maniskills
    actions(published, tmp_path / "actions")
    openvla_convert.test_the_state_is_normalised_by_the_originals_mask(published, tmp_path / "state")
    whole = openvla_whole_path
    for case in whole.CASES:
        with monkeypatch.context() as patch:
            whole.test_an_episode_executes_what_the_original_predicts(published, tmp_path / case, patch, case)
    for is_cropped, name in ((False, "resized"), (True, "center_cropped")):
        whole.test_an_image_of_another_size_is_resized_and_cropped_as_by_the_original(
            published, tmp_path / name, is_cropped, name
        )
    for case in ("img1.prompt1", "img2.prompt1", "img2.prompt2.proprio"):
        out = tmp_path / f"loss-{case}"
        whole.test_the_loss_of_the_policy_and_its_parts_are_the_originals(published, out, case)
    assert openvla_golden.values().unread() == set()


def test_every_value_of_the_sequence_models_is_compared() -> None:
    io = GoldenValues(sequence.GOLDEN)
    for name in ("rate", "gtrxl", "decision_transformer"):
        sequence.test_segments_are_answered_as_by_rates_code(io, name, 100)
    sequence.test_slots_are_read_and_written_as_by_elmurs_code(io, 100)
    sequence.test_decision_mamba_answers_as_the_authors_blocks(io)
    assert io.unread() == set()
