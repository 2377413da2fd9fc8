"""sb3-contrib's network with an LSTM, asked for a whole sequence at once where that is the same.

The library cuts what it collected into sequences where episodes begin, and then runs each a step at a time,
because it has to begin with an empty memory: 20 to 120 calls in place of one.
"""

from typing import Any

import torch
from sb3_contrib.common.recurrent.policies import RecurrentMultiInputActorCriticPolicy
from torch import Tensor, nn


class WholeSequences(RecurrentMultiInputActorCriticPolicy):
    """The same network; numbers agree with the library's up to rounding (tested).

    Args:
        lstm_forget_bias: first bias of the forget gates. At 0, half of a memory is gone after a step; at 3, a
            twentieth. Source: Jozefowicz et al. 2015, section 2.3.
    """

    def __init__(self, *args: Any, lstm_forget_bias: float = 0.0, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        for lstm in (self.lstm_actor, self.lstm_critic):
            if isinstance(lstm, nn.LSTM) and lstm_forget_bias:
                for layer in range(lstm.num_layers):
                    forget = slice(lstm.hidden_size, 2 * lstm.hidden_size)
                    getattr(lstm, f"bias_ih_l{layer}").data[forget] = lstm_forget_bias
                    getattr(lstm, f"bias_hh_l{layer}").data[forget] = 0.0

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
