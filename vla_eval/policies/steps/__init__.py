"""Steps that several ported policies share: normalisation, gripper, pictures, trainable parameters."""
