"""Steps that several ported policies share: normalisation, gripper, images, trainable parameters."""
