"""sb3-contrib's network with an LSTM, asked for a whole sequence at once where that is the same.

The library cuts what it collected into sequences where episodes begin, and then runs each a step at a time,
because it has to begin with an empty memory: 20 to 120 calls in place of one.
"""

from typing import Any

import torch
from sb3_contrib.common.recurrent.policies import RecurrentMultiInputActorCriticPolicy
from torch import Tensor, nn


class WholeSequences(RecurrentMultiInputActorCriticPolicy):
    """The same network; numbers agree with the library's up to rounding (tested)."""

    @staticmethod
    def _process_sequence(
        features: Tensor, lstm_states: Any, episode_starts: Tensor, lstm: nn.LSTM
    ) -> tuple[Tensor, Any]:
        n_sequences = lstm_states[0].shape[1]
        starts = episode_starts.reshape((n_sequences, -1))
        if torch.any(starts[:, 1:] != 0):
            stepwise: tuple[Tensor, Any] = RecurrentMultiInputActorCriticPolicy._process_sequence(
                features, lstm_states, episode_starts, lstm
            )
            return stepwise
        kept = (1.0 - starts[:, 0]).view(1, n_sequences, 1)
        sequences = features.reshape((n_sequences, -1, lstm.input_size)).swapaxes(0, 1)
        output, lstm_states = lstm(sequences, (kept * lstm_states[0], kept * lstm_states[1]))
        return torch.flatten(output.transpose(0, 1), start_dim=0, end_dim=1), lstm_states
