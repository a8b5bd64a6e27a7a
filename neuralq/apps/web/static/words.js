// Numbers and verdicts in words.

export const VERDICTS = {
  "converges": ["good", "✓", "converges"],
  "diverges": ["bad", "✗", "diverges"],
  "mean-stable but variance diverges": ["bad", "⚠", "mean is stable, but the variance diverges"],
  "stable but poor fixed point": ["doubt", "≈", "converges to a poor fixed point"],
  "chatters": ["doubt", "↔", "chatters between greedy policies"],
  "neutral": ["doubt", "•", "neutral: neither grows nor shrinks"],
};

// A number as short as it can be said with so many significant digits.
export function short(value, digits = 4) {
  if (value === null || value === undefined) return "unknown";
  if (value === 0) return "0";
  const size = Math.abs(value);
  if (size >= 1e6 || size < 1e-4) {
    return value.toExponential(digits - 1).replace(/\.?0+e/, "e").replace("e+", "e");
  }
  return String(Number(value.toPrecision(digits)));
}

// Enough digits of a factor near 1 to see on which side it lies.
export function factor(value) {
  if (value === null || value === undefined) return "unknown";
  const off = Math.abs(value - 1);
  if (off === 0 || off > 0.1) return short(value, 5);
  return value.toFixed(Math.min(12, Math.max(4, Math.ceil(-Math.log10(off)) + 3)));
}

export function bound(one) {
  if (one.every) return "every α";
  if (one.value === 0) return "no α";
  return one.value === null ? "unknown" : `α < ${short(one.value, 5)}`;
}

export function list(words) {
  return words.length < 2 ? words.join("") : `${words.slice(0, -1).join(", ")} and ${words[words.length - 1]}`;
}
