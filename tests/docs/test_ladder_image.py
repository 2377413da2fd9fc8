"""The figures of the ladder's page."""

from scripts.ladder_image import correlation_row

DIAGNOSTIC, ROBOT = "mikasa_base/MemoryLengthEasy-v0", "RememberColor3-v0"  # both of objects
CORES = ["mlp", "gru", "lstm", "dt", "rate", "mamba", "elmur"]


def row(diagnostic: list[float], robot: list[float]) -> list[str]:
    ends = {
        end: {core: {task: score} for core, score in zip(CORES, scores, strict=True)}
        for end, task, scores in (("diagnostic", DIAGNOSTIC, diagnostic), ("robot", ROBOT, robot))
    }
    return [cell.strip() for cell in correlation_row("object", ends, CORES).strip("| ").split(" | ")]


def test_cores_in_the_same_order_at_both_ends_correlate_with_one() -> None:
    *sizes, rho, p = row([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [0, 0.5, 0.51, 0.52, 0.6, 0.9, 1])
    assert sizes == ["object", "7", "1", "1"]
    assert rho.startswith("1.00 [")
    assert float(p) < 0.01  # 2 of 5,040 orders are as far from 0


def test_the_reverse_order_correlates_with_minus_one() -> None:
    rho = row([0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6], [1, 0.9, 0.6, 0.52, 0.51, 0.5, 0])[4]
    assert rho.startswith("\N{MINUS SIGN}1.00 [")


def test_cores_that_are_all_alike_have_no_order() -> None:
    assert row([1.0] * 7, [0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6])[4] == "all alike at one end"
