//! The two sums that cost the time of a point: the kernel part and the variance of the linear part.
//!
//! Written over lanes so that the compiler vectorises them; compiled once for any processor and once for AVX2 with
//! fused multiply-add, chosen when the model is decoded.

/// Samples in a block; what is missing in the last one is filled up with samples that are infinitely far away.
pub const LANES: usize = 8;
type Block = [f64; LANES];

const LOG2_E: f64 = std::f64::consts::LOG2_E;
const LN2_HIGH: f64 = 6.931_471_803_691_238e-1;
const LN2_LOW: f64 = 1.908_214_929_270_587_7e-10;
/// Adding 1.5 * 2^52 leaves the nearest integer in the low bits of the double.
const ROUND: f64 = 6_755_399_441_055_744.0;
/// Below this the result is 0: exp(-708) is 3e-308.
const UNDERFLOW: f64 = -708.0;
/// Taylor coefficients of (exp(r) - 1 - r)/r², highest first.
const TAYLOR: [f64; 11] = [
    1.0 / 479_001_600.0,
    1.0 / 39_916_800.0,
    1.0 / 3_628_800.0,
    1.0 / 362_880.0,
    1.0 / 40_320.0,
    1.0 / 5_040.0,
    1.0 / 720.0,
    1.0 / 120.0,
    1.0 / 24.0,
    1.0 / 6.0,
    0.5,
];

#[inline(always)]
fn fma<const FUSED: bool>(a: f64, b: f64, c: f64) -> f64 {
    if FUSED {
        a.mul_add(b, c)
    } else {
        a * b + c
    }
}

/// exp of each t <= 0, to 2 units in the last place.
#[inline(always)]
fn exp_negative<const FUSED: bool>(t: &Block) -> Block {
    let mut out = [0.0; LANES];
    for l in 0..LANES {
        let clipped = if t[l] > UNDERFLOW { t[l] } else { UNDERFLOW };
        let bits = fma::<FUSED>(clipped, LOG2_E, ROUND);
        let k = bits - ROUND;
        let power = f64::from_bits(bits.to_bits().wrapping_add(1023) << 52);
        let r = fma::<FUSED>(-k, LN2_LOW, fma::<FUSED>(-k, LN2_HIGH, clipped));
        let mut s = TAYLOR[0];
        for c in &TAYLOR[1..] {
            s = fma::<FUSED>(s, r, *c);
        }
        let value = (fma::<FUSED>(r * r, s, r) + 1.0) * power;
        out[l] = if t[l] < UNDERFLOW { 0.0 } else { value };
    }
    out
}

/// The samples of a model, ready to be summed: blocks of `LANES` samples, each feature's row and then the weights.
#[derive(Clone, Debug)]
pub struct Samples {
    d: usize,
    /// One block after another: (d + 1) rows of `LANES`.
    rows: Vec<Block>,
    sum: fn(&Samples, &[f64]) -> (f64, f64),
}

impl Samples {
    /// `support` (n, d) row-major, `widths` (d,), `alpha` (n,).
    pub fn new(support: &[f64], widths: &[f64], alpha: &[f64]) -> Samples {
        let d = widths.len();
        let mut rows = Vec::with_capacity(alpha.len().div_ceil(LANES) * (d + 1));
        for (b, weights) in alpha.chunks(LANES).enumerate() {
            for i in 0..d {
                rows.push(std::array::from_fn(|l| match weights.get(l) {
                    Some(_) => support[(b * LANES + l) * d + i] / widths[i],
                    None => 1e150,
                }));
            }
            rows.push(std::array::from_fn(|l| weights.get(l).copied().unwrap_or(0.0)));
        }
        Samples { d, rows, sum: if fused() { sum_fused } else { sum_plain } }
    }

    /// (Σ alpha k, the largest k) for one point; `scaled` (d,) are its inputs divided by the widths.
    #[inline]
    pub fn sum(&self, scaled: &[f64]) -> (f64, f64) {
        (self.sum)(self, scaled)
    }
}

#[inline(always)]
fn sum_over<const FUSED: bool>(samples: &Samples, scaled: &[f64]) -> (f64, f64) {
    let (mut total, mut largest) = ([0.0; LANES], [0.0; LANES]);
    let scaled = &scaled[..samples.d];
    for rows in samples.rows.chunks_exact(samples.d + 1) {
        let mut t = [0.0; LANES];
        for (row, x) in rows.iter().zip(scaled) {
            for l in 0..LANES {
                let apart = row[l] - x;
                t[l] = fma::<FUSED>(-apart, apart, t[l]);
            }
        }
        let k = exp_negative::<FUSED>(&t);
        let weights = &rows[samples.d];
        for l in 0..LANES {
            total[l] = fma::<FUSED>(weights[l], k[l], total[l]);
            largest[l] = if k[l] > largest[l] { k[l] } else { largest[l] };
        }
    }
    (total.iter().sum(), largest.iter().fold(0.0, |a: f64, b| a.max(*b)))
}

fn sum_plain(samples: &Samples, scaled: &[f64]) -> (f64, f64) {
    sum_over::<false>(samples, scaled)
}

/// basis' C basis of a symmetric matrix, which is kept as the rows of its upper triangle in blocks.
#[derive(Clone, Debug)]
pub struct Quadratic {
    /// Row j holds C[j, i] for the blocks of i from the block of j on; off the diagonal twice. Zero before j.
    rows: Vec<Block>,
    p: usize,
    form: fn(&Quadratic, &[Block]) -> f64,
}

/// Blocks that hold a vector of p doubles.
pub fn blocks(p: usize) -> usize {
    p.div_ceil(LANES)
}

impl Quadratic {
    /// `covariance` (p, p), or empty for none.
    pub fn new(covariance: &[f64], p: usize) -> Quadratic {
        let mut rows = Vec::new();
        if !covariance.is_empty() {
            for j in 0..p {
                for b in j / LANES..blocks(p) {
                    rows.push(std::array::from_fn(|l| match b * LANES + l {
                        i if i == j => covariance[j * p + j],
                        i if i > j && i < p => covariance[j * p + i] + covariance[i * p + j],
                        _ => 0.0,
                    }));
                }
            }
        }
        Quadratic { rows, p, form: if fused() { form_fused } else { form_plain } }
    }

    /// The value for a basis in blocks; 0 where there is no matrix.
    #[inline]
    pub fn form(&self, basis: &[Block]) -> f64 {
        if self.rows.is_empty() {
            return 0.0;
        }
        (self.form)(self, basis)
    }
}

#[inline(always)]
fn form_over<const FUSED: bool>(quadratic: &Quadratic, basis: &[Block]) -> f64 {
    let mut total = [0.0; LANES];
    let mut rows = &quadratic.rows[..];
    let count = blocks(quadratic.p);
    let basis = &basis[..count];
    for j in 0..quadratic.p {
        let (own, rest) = rows.split_at(count - j / LANES);
        rows = rest;
        let mut sum = [0.0; LANES];
        for (row, b) in own.iter().zip(&basis[j / LANES..]) {
            for l in 0..LANES {
                sum[l] = fma::<FUSED>(row[l], b[l], sum[l]);
            }
        }
        let bj = basis[j / LANES][j % LANES];
        for l in 0..LANES {
            total[l] = fma::<FUSED>(sum[l], bj, total[l]);
        }
    }
    total.iter().sum()
}

fn form_plain(quadratic: &Quadratic, basis: &[Block]) -> f64 {
    form_over::<false>(quadratic, basis)
}

#[cfg(target_arch = "x86_64")]
fn fused() -> bool {
    std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("fma")
}

#[cfg(target_arch = "x86_64")]
mod avx2 {
    use super::{form_over, sum_over, Block, Quadratic, Samples};

    #[target_feature(enable = "avx2,fma")]
    pub unsafe fn sum(samples: &Samples, scaled: &[f64]) -> (f64, f64) {
        sum_over::<true>(samples, scaled)
    }

    #[target_feature(enable = "avx2,fma")]
    pub unsafe fn form(quadratic: &Quadratic, basis: &[Block]) -> f64 {
        form_over::<true>(quadratic, basis)
    }
}

#[cfg(target_arch = "x86_64")]
fn sum_fused(samples: &Samples, scaled: &[f64]) -> (f64, f64) {
    // SAFETY: chosen only where `fused` has found both instruction sets.
    unsafe { avx2::sum(samples, scaled) }
}

#[cfg(target_arch = "x86_64")]
fn form_fused(quadratic: &Quadratic, basis: &[Block]) -> f64 {
    // SAFETY: chosen only where `fused` has found both instruction sets.
    unsafe { avx2::form(quadratic, basis) }
}

// Every 64-bit ARM has fused multiply-add.
#[cfg(not(target_arch = "x86_64"))]
fn fused() -> bool {
    cfg!(target_arch = "aarch64")
}

#[cfg(not(target_arch = "x86_64"))]
fn sum_fused(samples: &Samples, scaled: &[f64]) -> (f64, f64) {
    sum_over::<true>(samples, scaled)
}

#[cfg(not(target_arch = "x86_64"))]
fn form_fused(quadratic: &Quadratic, basis: &[Block]) -> f64 {
    form_over::<true>(quadratic, basis)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A generator of numbers from -1 to 1 (xorshift), so that the tests repeat.
    fn numbers(seed: u64) -> impl FnMut() -> f64 {
        let mut state = seed;
        move || {
            state ^= state << 13;
            state ^= state >> 7;
            state ^= state << 17;
            (state >> 11) as f64 / (1u64 << 52) as f64 - 1.0
        }
    }

    #[test]
    fn exponential_is_that_of_the_library() {
        for i in 0..30_000 {
            let t = -0.0237 * f64::from(i);
            for value in [exp_negative::<false>(&[t; LANES])[3], exp_negative::<true>(&[t; LANES])[3]] {
                if t < UNDERFLOW {
                    assert_eq!(value, 0.0);
                } else {
                    assert!((value / t.exp() - 1.0).abs() < 5e-16, "{t}: {value} {}", t.exp());
                }
            }
        }
        assert_eq!(exp_negative::<false>(&[0.0; LANES]), [1.0; LANES]);
        assert_eq!(exp_negative::<false>(&[f64::NEG_INFINITY; LANES]), [0.0; LANES]);
    }

    #[test]
    fn both_forms_give_the_plain_sums() {
        let mut next = numbers(7);
        for (n, d, p) in [(1, 2, 1), (8, 5, 8), (501, 5, 63), (0, 2, 3)] {
            let support: Vec<f64> = (0..n * d).map(|_| next()).collect();
            let widths: Vec<f64> = (0..d).map(|_| 1.5 + next()).collect();
            let alpha: Vec<f64> = (0..n).map(|_| next()).collect();
            let x: Vec<f64> = (0..d).map(|_| next()).collect();
            let (mut total, mut largest) = (0.0, 0.0f64);
            for j in 0..n {
                let k = (-(0..d).map(|i| ((x[i] - support[j * d + i]) / widths[i]).powi(2)).sum::<f64>()).exp();
                total += alpha[j] * k;
                largest = largest.max(k);
            }
            let scaled: Vec<f64> = x.iter().zip(&widths).map(|(x, w)| x / w).collect();
            let samples = Samples::new(&support, &widths, &alpha);
            for (sum, nearest) in [samples.sum(&scaled), sum_plain(&samples, &scaled)] {
                assert!((sum - total).abs() < 1e-13 && (nearest - largest).abs() < 1e-15);
            }
            let c: Vec<f64> = (0..p * p).map(|_| next()).collect();
            let b: Vec<f64> = (0..p).map(|_| next()).collect();
            let expected: f64 = (0..p * p).map(|i| b[i / p] * c[i] * b[i % p]).sum();
            let mut basis = vec![[0.0; LANES]; blocks(p)];
            for (i, value) in b.iter().enumerate() {
                basis[i / LANES][i % LANES] = *value;
            }
            let quadratic = Quadratic::new(&c, p);
            for form in [quadratic.form(&basis), form_plain(&quadratic, &basis)] {
                assert!((form - expected).abs() < 1e-12, "{form} {expected}");
            }
            assert_eq!(Quadratic::new(&[], p).form(&basis), 0.0);
        }
    }
}
