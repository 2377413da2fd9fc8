"""Names of cores, and what has to be known of them before they are made. Without torch."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any  # values of a recipe

from vla_eval.errors import RecipeError, check_names
from vla_eval.strict.bounds import check_bounds
from vla_eval.strict.decoding import decode

MANY = 1 << 16  # more than any of these counts needs
BELOW_ONE = 1 - 1e-6


@dataclass(frozen=True, slots=True, kw_only=True)
class NoOptions:
    """A core that has no sizes of its own."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RecurrentOptions:
    """How a GRU or an LSTM remembers (docs/learning_the_rule.md)."""

    # added at the beginning to the bias of the gate that keeps the state (Gers et al. 2000, "Learning to
    # Forget"; of a GRU: its update gate). More of what was seen first is left then.
    keep_bias: float = 0.0
    # the answer to a step is the state before it, normalised, in place of that after it. The head reads
    # the step itself anyway; so what was remembered is not mixed with it.
    answers_before: bool = False

    def __post_init__(self) -> None:
        check_bounds(self, {"keep_bias": (-10, 10)}, prefix="")


@dataclass(frozen=True, slots=True, kw_only=True)
class TransformerXLOptions:
    """Sizes of Decision Transformer, RATE and GTrXL beyond those of every core."""

    head_width: int = 128
    inner_width: int = 64  # of the feed-forward layers; 0: there are none
    attention_dropout: float = 0.2
    cached_tokens: int = 0  # hidden states of earlier segments that are kept
    memory_tokens: int = 0  # that a segment reads at its beginning and writes at its end
    # of the attention between old memory tokens and what was written; 0: there is no valve
    valve_heads: int = 0
    carries_gradient: bool = True  # whether later segments teach a segment what to write
    gated: bool = False  # GTrXL's gates instead of sums

    def __post_init__(self) -> None:
        counts = ("inner_width", "cached_tokens", "memory_tokens", "valve_heads")
        check_bounds(self, {**dict.fromkeys(counts, (0, MANY)), "head_width": (1, MANY)}, prefix="")
        check_bounds(self, {"attention_dropout": (0, BELOW_ONE)}, prefix="")
        if self.valve_heads and not self.memory_tokens:
            raise RecipeError(f"valve_heads is {self.valve_heads}, expected 0: there are no memory_tokens")
        if self.gated and not self.inner_width:
            raise RecipeError("inner_width is 0, expected a number ≥ 1: gated layers have one")


@dataclass(frozen=True, slots=True, kw_only=True)
class MambaOptions:
    """Sizes of Mamba's blocks: Gu and Dao 2023, "Mamba", section 3.4."""

    state: int = 16  # numbers that are kept of each unit
    convolved: int = 4  # tokens that the short convolution reads
    expand: int = 2  # units of a block, in widths

    def __post_init__(self) -> None:
        check_bounds(self, {"state": (1, MANY), "convolved": (2, MANY), "expand": (1, MANY)}, prefix="")


@dataclass(frozen=True, slots=True, kw_only=True)
class ElmurOptions:
    """Sizes of ELMUR beyond those of every core."""

    slots: int = 256  # of each layer's memory; a segment writes one
    blend: float = 0.407  # share of what is new in a slot that is written again
    slot_scale: float = 0.1  # standard deviation of what slots hold before they are written
    experts: int = 16  # each token is sent to one of them, and to the one for all
    inner_width: int = 128
    attention_dropout: float = 0.3
    memory_dropout: float = 0.055
    longest: int = 1024  # distances in tokens beyond this count as this
    carries_gradient: bool = True  # whether later segments teach a segment what to write

    def __post_init__(self) -> None:
        counts = ("slots", "experts", "inner_width", "longest")
        shares = {"attention_dropout": (0, BELOW_ONE), "memory_dropout": (0, BELOW_ONE), "blend": (0, 1)}
        check_bounds(self, {**dict.fromkeys(counts, (1, MANY)), **shares, "slot_scale": (0, MANY)}, prefix="")


CoreOptions = NoOptions | RecurrentOptions | TransformerXLOptions | MambaOptions | ElmurOptions


@dataclass(frozen=True, slots=True, kw_only=True)
class CoreRow:
    """What has to be known of a core before it is made."""

    # False: each step is answered alone, and the policy is shown only the last frame
    remembers: bool = True
    heads_divide: bool = False  # its heads divide the width
    is_even: bool = False  # the width is even, half of it for sines and half for cosines
    options: CoreOptions = NoOptions()  # its other sizes, as they are if a recipe says nothing
    # which of them make the core what it is, so that a recipe may not set them
    fixed: tuple[str, ...] = ()


CORES = {
    "mlp": CoreRow(remembers=False),
    "gru": CoreRow(options=RecurrentOptions()),
    "lstm": CoreRow(options=RecurrentOptions()),
    "transformer": CoreRow(heads_divide=True, is_even=True),
    "decision_transformer": CoreRow(
        is_even=True,
        options=TransformerXLOptions(),
        fixed=("cached_tokens", "memory_tokens", "valve_heads", "carries_gradient", "gated"),
    ),
    "rate": CoreRow(
        is_even=True,
        options=TransformerXLOptions(inner_width=0, cached_tokens=300, memory_tokens=10),
        fixed=("gated",),
    ),
    "gtrxl": CoreRow(
        is_even=True,
        options=TransformerXLOptions(cached_tokens=300, gated=True),
        fixed=("memory_tokens", "valve_heads", "carries_gradient", "gated"),
    ),
    "decision_mamba": CoreRow(options=MambaOptions()),
    "elmur": CoreRow(heads_divide=True, is_even=True, options=ElmurOptions()),
}


def check_core(
    core: str, *, width: int, heads: int, given: Mapping[str, Any], prefix: str = ""
) -> CoreOptions:
    """Return the options of a core, of which a recipe gives `given`.

    Args:
        core: a name of `CORES`.
        width: units of a token.
        heads: of its attention, where it has any.
        given: options that differ from the row's.
        prefix: of the recipe's fields, in messages.

    Raises:
        RecipeError: there is no such option or value, or the width goes with neither the core nor its heads.
    """
    row, options = CORES[core], options_of(core, given, where=f"{prefix}core_options")
    multiple = (heads if row.heads_divide else 1) * (2 if row.is_even else 1)
    if width % multiple:
        parts = f"2 · heads ({multiple})" if row.heads_divide else str(multiple)
        raise RecipeError(f"{prefix}width is {width}, expected a multiple of {parts} for the core '{core}'")
    valve = options.valve_heads if isinstance(options, TransformerXLOptions) else 0
    if valve and width % valve:
        raise RecipeError(f"{prefix}width is {width}, expected a multiple of valve_heads ({valve})")
    return options


def options_of(core: str, given: Mapping[str, Any], *, where: str = "core_options") -> CoreOptions:
    """Return the options of a core, with the values that a recipe gives."""
    row, where = CORES[core], f"{where} (core '{core}')"
    known = [field.name for field in fields(row.options) if field.name not in row.fixed]
    check_names("option", given, known, where=where)
    return decode(type(row.options), {**asdict(row.options), **given}, where=where)
