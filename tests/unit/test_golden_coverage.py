"""No stored value is compared by nothing: the comparisons are run again, and what they read is noted.

Here and not at the end of the other tests: those run in several processes, and in any selection.
"""

from safetensors.torch import load_file

from tests.unit import spatialvla_golden
from tests.unit import test_octo_parity as octo
from tests.unit import test_octo_policy as octo_policy
from tests.unit import test_octo_whole_path as octo_whole_path
from tests.unit import test_policy_steps as steps
from tests.unit import test_spatialvla_network as network
from tests.unit import test_spatialvla_policy as policy
from tests.unit import test_spatialvla_tokens as tokens
from tests.unit.golden_values import GoldenValues

OF_CONVERSION = {"unnorm.ids", "unnorm.actions"}  # read in test_spatialvla_convert, from a converted folder
# Of robots with fewer dimensions, whose other ones the original fills with noise: ours fill all.
NOT_IMPLEMENTED = "sample.w2_ead5."


def test_every_value_of_octo_is_compared() -> None:
    io = GoldenValues(octo.GOLDEN / "io.safetensors")
    weights = load_file(octo.GOLDEN / "weights.safetensors")
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
    spatialvla_golden.values.cache_clear()
    vision, inference, training = network.TestVision(), network.TestInference(), network.TestTraining()
    vision.test_the_depth_model_is_shown_padded_pictures()
    for camera in ("default", "mikasa"):
        vision.test_points_in_space_position_encoding_and_features(camera)
    vision.test_every_picture_has_a_camera_of_its_own()
    vision.test_siglips_last_state()
    for index in range(len(network.ALL)):
        inference.test_logits_tokens_and_actions(index)
    inference.test_two_pictures()
    for name, pictures in network.TRAININGS:
        for regime, attention in network.REGIMES:
            training.test_logits_loss_and_gradients_of_a_padded_batch(name, pictures, regime, attention)
    for name, prefix in tokens.GRIDS:
        tokens.TestGrid().test_edges_are_the_originals(name, prefix)
    for name in ("uniform", "gaussian"):
        tokens.TestTokens().test_there_back_and_there_again_are_the_originals(name)
    tokens.TestTokens().test_every_token_in_every_column_is_decoded_as_the_original_does()
    tokens.TestRefit().test_the_original_interpolates_between_the_same_middles_but_takes_roll_for_pitch()
    policy.TestPictures().test_the_originals_are_the_same()
    steps.TestNormalizer().test_q01_q99_is_that_of_the_original_and_back_what_was_not_cut()
    assert spatialvla_golden.values().unread() == OF_CONVERSION
