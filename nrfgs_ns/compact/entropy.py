# SPDX-License-Identifier: Apache-2.0
"""An entropy coder for tables of integers with similar neighbours: rANS in lanes, in integer arithmetic.

A table has C columns of n numbers; row i follows row i - 1 in space. A number is coded as its residual: the number less
a linear prediction from its neighbours (two rows before it, and two columns to its left). The residual's distribution
depends on how large the neighbours' residuals are. Frequencies and weights are integers in the stream; nothing here or
in a reader rounds, so that a reader in another language decodes the same numbers, to the bit.

The coder is range ANS (Duda, arXiv 1311.2540) with 32-bit states, 16-bit words and 14-bit frequencies, interleaved
(Giesen, arXiv 1402.3392): all lanes take a step at once, which makes it fast in numpy. It writes

    bytes
    4 L    a state for each of the L lanes, uint32, >= 2^16
           words, uint16, to the end of the stream

L is the smallest power of two >= C n / 2048, at most 1024; S = ceil(n / L). Lane l has the rows from l S to l S + S - 1
that exist. Columns are coded one after the other; of a column, step t = 0, ..., S - 1 codes row l S + t of each lane
that has it: the first ceil((n - t) / S) lanes. The model has, for each column in turn,

    numbers
    1       1: the column is signed and predicted; 0: it is neither
    7       weights w0, ..., w6 of the prediction, in 1/256
    4       shares s1, ..., s4 of the neighbours in the activity
    1 + K   K < 16, and K thresholds, rising
            for each of the K + 1 contexts: the first token that occurs, the number of tokens from it on, and their
            frequencies, whose sum is 2^14. Other tokens have frequency 0

x(i, c) is the number in row i and column c, and t(i, c) its token; both are 0 outside of the table, and before a lane's
first row. The activity is s1 t(i-1, c) + s2 t(i-2, c) + s3 t(i, c-1) + s4 t(i, c-2), with rows i-1 and i-2 of the same
lane; the context k is the number of thresholds that are not above it. In a step, each lane with a row, in turn, takes
its token from its state X:

    slot = X mod 2^14
    token: the one with start <= slot < start + frequency, in context k; start is the sum of smaller tokens' frequencies
    X = frequency (X div 2^14) + slot - start
    if X < 2^16: X = 2^16 X + the next word

A token below 32 is the number u itself. Token 32 + 4 e + m stands for the 2^b numbers u from (4 + m) 2^b on, b = e + 3,
of which the b low bits choose one. After all lanes have their token, each lane with a token of 32 or more takes the
lower min(b, 16) of these bits; after that, each takes the others, if there are any. To take r bits:

    bits = X mod 2^r,   X = X div 2^r,   if X < 2^16: X = 2^16 X + the next word

In a column that is not signed, x = u. In a signed one, x is the prediction plus 0, -1, 1, -2, 2, ... for
u = 0, 1, 2, 3, 4, ...; the prediction is, rounded down,

    (128 + w0 + w1 x(i-1, c) + w2 x(i-2, c) + w3 x(i, c-1) + w4 x(i-1, c-1) + w5 x(i, c-2) + w6 x(i-1, c-2)) div 256

At the end every state is 2^16 and no word is left; a reader checks this.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

Array = np.ndarray

PRECISION = 14
"""Bits of a frequency: the sum over a context is 2^14."""
LOWEST = 1 << 16
"""Smallest state."""
WORD = 16
MOST_LANES = 1024
SYMBOLS_OF_A_LANE = 2048
DIRECT = 32
"""Residuals with their own token; larger ones share a token with those of the same first three bits."""
TOKENS = DIRECT + 4 * 27
CONTEXTS = (1, 2, 3, 4, 6, 8, 12)
"""Numbers of contexts that an encoder tries for a column."""
MOST_CONTEXTS = 16
BITS_OF_A_FREQUENCY = 10
"""Approximate cost of a frequency in a stream."""
ACTIVITY = 4
"""Neighbours whose tokens predict a residual's size."""
LARGEST_SHARE = 16
MOST_ACTIVITY = ACTIVITY * LARGEST_SHARE * (TOKENS - 1)
SHIFT = 8
"""Fractional bits of a prediction's weights."""
PREDICTORS = 6
LARGEST_WEIGHT = 1 << 16
LARGEST = 1 << 32
NO_PREDICTION: tuple[list[int], Array | int] = [0] * (1 + PREDICTORS), 0
MOST_MODEL = 2 + PREDICTORS + ACTIVITY + 1 + MOST_CONTEXTS * (3 + TOKENS)
"""Largest number of integers that describe a column."""


def expect(right: bool, otherwise: str) -> None:
    """Raise ValueError, which says what a file is otherwise, unless it is right."""
    if not right:
        raise ValueError(otherwise)


class _Lanes:
    """The layout of a table [C, n] in coding order: [2 + C, 2 + S, lanes], with zeros before the first column, before
    each lane's first row and behind the last row."""

    def __init__(self, columns: int, rows: int):
        wanted = -(-columns * rows // SYMBOLS_OF_A_LANE)
        self.columns, self.rows = columns, rows
        self.lanes = min(1 << max(wanted - 1, 0).bit_length(), MOST_LANES)
        self.steps = -(-rows // self.lanes)

    def zeros(self, columns: int) -> Array:
        return np.zeros((columns, 2 + self.steps, self.lanes), dtype=np.int64)

    def laid(self, table: Array) -> Array:
        laid, padded = self.zeros(2 + len(table)), np.zeros((len(table), self.lanes * self.steps), dtype=np.int64)
        padded[:, : self.rows] = table
        laid[2:, 2:] = padded.reshape(len(table), self.lanes, self.steps).transpose(0, 2, 1)
        return laid

    def table(self, laid: Array) -> Array:
        return laid[2:, 2:].transpose(0, 2, 1).reshape(self.columns, self.lanes * self.steps)[:, : self.rows]

    def active(self, step: int) -> int:
        """Number of lanes, the first ones, that have a row in a step."""
        return -(-(self.rows - step) // self.steps)


# ---- encoding


def encode_table(table: Array, signed: bool = True) -> tuple[Array, bytes]:
    """The model, int32 numbers, and the coder's bytes of a table of integers [C, n].

    If signed, |x| < 2^31, and numbers are predicted; otherwise they are from 0 to 2^32 - 1.
    """
    columns, rows = table.shape
    lanes = _Lanes(columns, rows)
    laid, tokens = lanes.laid(table), lanes.zeros(2 + columns)
    real = lanes.laid(np.ones((1, rows)))[2, 2:].astype(bool)
    spares, lows, frequencies, starts = np.zeros((4, columns, *real.shape), dtype=np.int64)
    model: list[int] = []
    for column in range(columns):
        numbers = laid[2 + column, 2:]
        weights, prediction = _fitted_prediction(*laid[column : column + 3], real) if signed else NO_PREDICTION
        if np.abs(numbers - prediction).max(initial=0) >= LARGEST >> 1:
            weights, prediction = NO_PREDICTION
        residuals = numbers - prediction
        unsigned = np.where(residuals < 0, -2 * residuals - 1, 2 * residuals) if signed else residuals
        unsigned = np.where(real, unsigned, 0)
        bits = np.frexp(np.maximum(unsigned, 1).astype(np.float64))[1].astype(np.int64) - 1
        spares[column] = np.where(unsigned < DIRECT, 0, bits - 2)
        far = DIRECT + 4 * (bits - 5) + ((unsigned >> spares[column]) & 3)
        tokens[2 + column, 2:] = np.where(unsigned < DIRECT, unsigned, far)
        lows[column] = unsigned & ((1 << spares[column]) - 1)
        shares, thresholds, contexts = _fitted_contexts(*tokens[column : column + 3], real)
        model += [int(signed), *weights, *shares, len(thresholds), *thresholds]
        places = contexts * TOKENS + tokens[2 + column, 2:]
        counts = np.bincount(places[real], minlength=(len(thresholds) + 1) * TOKENS).reshape(-1, TOKENS)
        table = np.array([_normalised(row) for row in counts])
        for row in table:
            used = np.flatnonzero(row)
            model += [used[0], used[-1] - used[0] + 1, *row[used[0] : used[-1] + 1]]
        frequencies[column] = table.take(places)
        starts[column] = (np.cumsum(table, axis=1) - table).take(places)
    coded = _coded(lanes, *np.stack([frequencies, starts]).astype(np.uint64), spares, lows)
    return np.array(model, dtype=np.int32), coded


def _least_squares(inputs: list[Array], target: Array, real: Array, relative: float, absolute: float) -> Array:
    """Coefficients of a constant and of the inputs, with a ridge relative to the gram matrix's trace."""
    matrix = np.stack([np.ones_like(target), *inputs])[:, real].astype(np.float64)
    gram = matrix @ matrix.T
    ridge = relative * np.trace(gram) + absolute
    return np.linalg.solve(gram + ridge * np.eye(len(gram)), matrix @ target[real].astype(np.float64))


def _fitted_prediction(left_2: Array, left: Array, own: Array, real: Array) -> tuple[list[int], Array]:
    """Weights, in 1/2^SHIFT, and predictions of a column `own` from the two to its left."""
    inputs = [own[1:-1], own[:-2], left[2:], left[1:-1], left_2[2:], left_2[1:-1]]
    fit = _least_squares(inputs, own[2:], real, 1e-6 / (1 + PREDICTORS), 1e-9)
    weights = np.rint(fit * (1 << SHIFT)).clip(-LARGEST_WEIGHT, LARGEST_WEIGHT).astype(np.int64)
    total = weights[0] + (1 << (SHIFT - 1)) + np.tensordot(weights[1:], inputs, 1)
    return weights.tolist(), total >> SHIFT


def _fitted_contexts(left_2: Array, left: Array, own: Array, real: Array) -> tuple[list[int], list[int], Array]:
    """Shares of the neighbours' tokens in the activity, its thresholds, and each number's context."""
    neighbours, own = [own[1:-1], own[:-2], left[2:], left_2[2:]], own[2:]
    if not real.any():
        return [0] * ACTIVITY, [], np.zeros_like(own)
    fit = _least_squares(neighbours, own, real, 1e-6, 1e-6)[1:]
    shares = np.rint(LARGEST_SHARE * fit.clip(0, None) / max(fit.max(), 1e-9)).astype(np.int64).clip(0, LARGEST_SHARE)
    activity = np.tensordot(shares, neighbours, 1)
    counts = np.bincount((activity * TOKENS + own)[real], minlength=(MOST_ACTIVITY + 1) * TOKENS)
    counts = counts.reshape(MOST_ACTIVITY + 1, TOKENS)
    levels = np.flatnonzero(counts.any(axis=1))
    below = np.concatenate([np.zeros((1, TOKENS), dtype=np.int64), np.cumsum(counts[levels], axis=0)])
    share = below.sum(axis=1) / below[-1].sum()
    firsts, least = [0], np.inf
    for count in CONTEXTS:
        tried = np.unique(np.searchsorted(share[:-1], np.arange(count) / count))
        tried = tried[tried < len(levels)]
        bits = _bits(np.diff(below[[*tried, len(levels)]], axis=0))
        if bits < least:
            firsts, least = tried, bits
    thresholds = levels[firsts[1:]]
    return shares.tolist(), thresholds.tolist(), np.searchsorted(thresholds, activity, side="right")


def _bits(counts: Array) -> float:
    """Estimated bits of tokens and frequencies, by the tokens' counts in each context [K, TOKENS]."""
    totals = counts.sum(axis=1, keepdims=True).clip(1)
    entropy = -(counts * np.log2(np.where(counts > 0, counts / totals, 1.0))).sum()
    return float(entropy + BITS_OF_A_FREQUENCY * (counts > 0).sum())


def _normalised(counts: Array) -> Array:
    """Frequencies whose sum is 2^PRECISION, at least 1 where there is a count."""
    total = 1 << PRECISION
    if counts.sum() == 0:
        counts = np.eye(1, len(counts), dtype=np.int64)[0]
    shares = np.where(counts > 0, np.maximum(np.rint(counts * (total / counts.sum())), 1), 0).astype(np.int64)
    while (over := int(shares.sum()) - total) != 0:  # the most frequent token suffers least
        largest = int(shares.argmax())
        shares[largest] -= min(over, int(shares[largest]) - 1) if over > 0 else over
    return shares


def _coded(lanes: _Lanes, frequencies: Array, starts: Array, spares: Array, lows: Array) -> bytes:
    """The coder's bytes of tokens, by their frequencies and starts, and of their low bits, `spares` in number."""
    state = np.full(lanes.lanes, LOWEST, dtype=np.uint64)
    chunks: list[Array] = []

    def push(x: Array, limit: Array) -> Array:
        """Write a word of each lane whose state is not below the limit."""
        out = x >= limit
        if out.any():
            chunks.append((x[out] & np.uint64(0xFFFF)).astype("<u2"))
            x = np.where(out, x >> np.uint64(WORD), x)
        return x

    for column in reversed(range(lanes.columns)):
        for step in reversed(range(lanes.steps)):
            count = lanes.active(step)
            x = state[:count]
            spare, low = spares[column, step, :count], lows[column, step, :count]
            if (most := spare.max()) > 0:
                for shift in (WORD, 0) if most > WORD else (0,):  # the lower 16 bits are read first
                    bits = (spare - shift).clip(0, WORD).astype(np.uint64)
                    x = push(x, np.uint64(1) << (np.uint64(32) - bits))
                    x = (x << bits) | ((low >> shift).astype(np.uint64) & ((np.uint64(1) << bits) - np.uint64(1)))
            frequency, start = frequencies[column, step, :count], starts[column, step, :count]
            x = push(x, frequency << np.uint64(32 - PRECISION))
            quotient = x // frequency
            state[:count] = (quotient << np.uint64(PRECISION)) + (x - quotient * frequency) + start
    return state.astype("<u4").tobytes() + b"".join(chunk.tobytes() for chunk in reversed(chunks))


# ---- decoding


def decode_table(model: Array, data: bytes, columns: int, rows: int) -> Array:
    """Decode a table, int64 [C, n]; ValueError for an impossible model, and missing or spare words."""
    lanes = _Lanes(columns, rows)
    expect(len(data) >= 4 * lanes.lanes and len(data) % 2 == 0, "too few bytes for its lanes")
    state = np.frombuffer(data, "<u4", lanes.lanes).astype(np.int64)
    words = np.frombuffer(data, "<u2", offset=4 * lanes.lanes).astype(np.int64)
    expect((state >= LOWEST).all(), "a state is too small")
    laid, tokens = lanes.zeros(2 + columns), lanes.zeros(3)  # tokens of a column and of the two to its left, in turn
    at = 0
    for column, part in enumerate(_read_model(model, columns)):
        left_2, left, own = laid[column : column + 3]
        w0, w1, w2, w3, w4, w5, w6 = part.weights
        base = (1 << (SHIFT - 1)) + w0 + w3 * left[2:] + w4 * left[1:-1] + w5 * left_2[2:] + w6 * left_2[1:-1]
        said = tokens[column % 3]
        s1, s2, s3, s4 = part.shares
        activity = s3 * tokens[(column - 1) % 3, 2:] + s4 * tokens[(column - 2) % 3, 2:]
        for step in range(lanes.steps):
            count = lanes.active(step)
            x = state[:count]
            likely = activity[step, :count] + s1 * said[step + 1, :count] + s2 * said[step, :count]
            slot = part.first_slot.take(likely) + (x & ((1 << PRECISION) - 1))
            token = part.tokens.take(slot)
            x = part.frequencies.take(slot) * (x >> PRECISION) + part.offsets.take(slot)
            x, at = _refilled(x, words, at)
            unsigned = token
            if (far := (token >= DIRECT).nonzero()[0]).size:
                large = token[far] - DIRECT
                spare, low, rest = (large >> 2) + 3, np.zeros_like(large), x[far]
                for shift in (0, WORD) if spare.max() > WORD else (0,):
                    bits = (spare - shift).clip(0, WORD)
                    low += (rest & ((1 << bits) - 1)) << shift
                    rest, at = _refilled(rest >> bits, words, at)
                x[far] = rest
                unsigned = token.copy()
                unsigned[far] = ((4 + (large & 3)) << spare) + low
            state[:count] = x
            said[step + 2, :count] = token
            if part.signed:
                expected = (base[step, :count] + w1 * own[step + 1, :count] + w2 * own[step, :count]) >> SHIFT
                unsigned = expected + ((unsigned >> 1) ^ -(unsigned & 1))
            own[step + 2, :count] = unsigned
        expect((np.abs(own) < LARGEST).all(), "a number is too large")
    expect(at == len(words) and (state == LOWEST).all(), "it does not end where its table does")
    return lanes.table(laid)


def _refilled(x: Array, words: Array, at: int) -> tuple[Array, int]:
    """Read a word into each lane whose state is below LOWEST."""
    low = (x < LOWEST).nonzero()[0]
    if low.size == 0:
        return x, at
    end = at + low.size
    expect(end <= len(words), "it is cut short")
    x[low] = (x[low] << WORD) | words[at:end]
    return x, end


class _Column(NamedTuple):
    """A column's model: a context's first slot by activity; and by slot, a context's number times 2^PRECISION plus a
    state's low bits, the token, its frequency, and the slot's distance from the token's first one."""

    signed: bool
    weights: list[int]
    shares: list[int]
    first_slot: Array
    tokens: Array
    frequencies: Array
    offsets: Array


def _read_model(model: Array, columns: int) -> Iterator[_Column]:
    """The columns of a model, one after the other; ValueError for an impossible one."""
    numbers, at = model.astype(np.int64), 0

    def take(count: int) -> Array:
        nonlocal at
        at += count
        expect(count >= 0 and at <= len(numbers), "its model is cut short")
        return numbers[at - count : at]

    for _ in range(columns):
        signed, *weights = take(2 + PREDICTORS).tolist()
        *shares, count = take(ACTIVITY + 1).tolist()
        thresholds = take(count)
        possible = count < MOST_CONTEXTS and (np.diff(thresholds) > 0).all()
        possible &= max(map(abs, weights)) <= LARGEST_WEIGHT and 0 <= min(shares) and max(shares) <= LARGEST_SHARE
        expect(possible, "its model is impossible")
        table = np.zeros((count + 1, TOKENS), dtype=np.int64)
        for frequencies in table:
            first, used = take(2).tolist()
            expect(0 <= first and 0 < used and first + used <= TOKENS, "its model has impossible tokens")
            frequencies[first : first + used] = take(used)
        possible = (table >= 0).all() and (table.sum(axis=1) == 1 << PRECISION).all()
        expect(possible, "its model has impossible frequencies")
        starts = np.cumsum(table, axis=1) - table
        tokens = np.repeat(np.tile(np.arange(TOKENS), count + 1), table.ravel())
        slots = np.arange(len(tokens)) & ((1 << PRECISION) - 1)
        contexts = np.searchsorted(thresholds, np.arange(MOST_ACTIVITY + 1), side="right") << PRECISION
        offsets = slots - np.repeat(starts.ravel(), table.ravel())
        frequencies = np.repeat(table.ravel(), table.ravel())
        yield _Column(bool(signed), weights, shares, contexts, tokens, frequencies, offsets)
    expect(at == len(numbers), "its model does not end where its table does")
