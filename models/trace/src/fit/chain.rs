//! A chain of two states in which messages are lost with two probabilities (Gilbert 1960, Elliott
//! 1963): likelihood, lengths of bursts, and estimation by expectation and maximisation (Baum,
//! Petrie, Soules and Weiss 1970). Independent losses are the chain whose states are equal.

/// Iterations after which an estimate is taken as it is.
const ITERATIONS_MAX: usize = 300;
/// Change of the log-likelihood, per message, at which an estimate has converged.
const PRECISION: f64 = 1e-9;
/// Keeps probabilities away from 0 and 1, where they could not move any more.
const TINY: f64 = 1e-9;

/// The chain; state 0 is good.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Chain {
    /// Probability per message of going from good to bad.
    pub(super) to_bad: f64,
    /// And back.
    pub(super) to_good: f64,
    /// Loss probability in the good and in the bad state.
    pub(super) loss: [f64; 2],
}

impl Chain {
    pub(super) fn independent(ratio: f64) -> Self {
        Self {
            to_bad: 0.5,
            to_good: 0.5,
            loss: [ratio, ratio],
        }
    }

    /// Share of the time in each state.
    pub(super) fn stationary(&self) -> [f64; 2] {
        let sum = self.to_bad + self.to_good;
        if sum <= 0.0 {
            return [0.5, 0.5];
        }
        [self.to_good / sum, self.to_bad / sum]
    }

    const fn steps(&self) -> [[f64; 2]; 2] {
        [
            [1.0 - self.to_bad, self.to_bad],
            [self.to_good, 1.0 - self.to_good],
        ]
    }

    fn emission(&self, is_lost: bool) -> [f64; 2] {
        self.loss
            .map(|loss| if is_lost { loss } else { 1.0 - loss })
    }

    /// Logarithm of the probability of `losses`; minus infinity when they cannot be.
    pub(super) fn log_likelihood(&self, losses: &[bool]) -> f64 {
        let steps = self.steps();
        let (mut state, mut sum) = (self.stationary(), 0.0);
        for is_lost in losses {
            let emission = self.emission(*is_lost);
            let joint = [state[0] * emission[0], state[1] * emission[1]];
            let total = joint[0] + joint[1];
            if total <= 0.0 {
                return f64::NEG_INFINITY;
            }
            sum += total.ln();
            let here = [joint[0] / total, joint[1] / total];
            state = [0, 1].map(|to| here[0] * steps[0][to] + here[1] * steps[1][to]);
        }
        sum
    }

    /// Probability that a burst of losses has more than 0, 1, 2, ... messages.
    pub(super) fn burst_survival(&self, length_max: usize) -> Vec<f64> {
        let (steps, stationary) = (self.steps(), self.stationary());
        let arrived = [0, 1].map(|state| stationary[state] * (1.0 - self.loss[state]));
        let lost_next = |state: [f64; 2]| {
            [0, 1].map(|to| (state[0] * steps[0][to] + state[1] * steps[1][to]) * self.loss[to])
        };
        let first = lost_next(arrived);
        let total = first[0] + first[1];
        if total <= 0.0 {
            return vec![0.0; length_max + 1];
        }
        let mut state = first.map(|share| share / total);
        let mut survival = vec![1.0];
        for _ in 0..length_max {
            state = lost_next(state);
            survival.push(state[0] + state[1]);
        }
        survival
    }

    /// The chain of largest likelihood that an ascent from `self` finds, and its log-likelihood.
    pub(super) fn improved(self, losses: &[bool]) -> (Self, f64) {
        let mut chain = self;
        let mut before = f64::NEG_INFINITY;
        for _ in 0..ITERATIONS_MAX {
            let (next, log_likelihood) = chain.step(losses);
            if log_likelihood - before < PRECISION * losses.len() as f64 {
                break;
            }
            (chain, before) = (next, log_likelihood);
        }
        (chain, chain.log_likelihood(losses))
    }

    /// One step of Baum and Welch, with the log-likelihood before it.
    fn step(&self, losses: &[bool]) -> (Self, f64) {
        let steps = self.steps();
        let mut forward: Vec<[f64; 2]> = Vec::with_capacity(losses.len());
        let mut scales: Vec<f64> = Vec::with_capacity(losses.len());
        let mut state = self.stationary();
        for is_lost in losses {
            let emission = self.emission(*is_lost);
            let joint = [state[0] * emission[0], state[1] * emission[1]];
            let total = (joint[0] + joint[1]).max(f64::MIN_POSITIVE);
            let here = [joint[0] / total, joint[1] / total];
            forward.push(here);
            scales.push(total);
            state = [0, 1].map(|to| here[0] * steps[0][to] + here[1] * steps[1][to]);
        }
        let log_likelihood = scales.iter().map(|scale| scale.ln()).sum();
        let (mut backward, mut moves) = ([1.0, 1.0], [[0.0; 2]; 2]);
        let (mut visits, mut lost) = ([0.0; 2], [0.0; 2]);
        for index in (0..losses.len()).rev() {
            let here = forward[index];
            let weight = [here[0] * backward[0], here[1] * backward[1]];
            let total = (weight[0] + weight[1]).max(f64::MIN_POSITIVE);
            for state in 0..2 {
                let share = weight[state] / total;
                visits[state] += share;
                lost[state] += if losses[index] { share } else { 0.0 };
            }
            if index == 0 {
                break;
            }
            let emission = self.emission(losses[index]);
            let next = [0, 1].map(|to| emission[to] * backward[to] / scales[index]);
            let before = forward[index - 1];
            for from in 0..2 {
                for to in 0..2 {
                    moves[from][to] += before[from] * steps[from][to] * next[to];
                }
            }
            backward = [0, 1].map(|from| steps[from][0] * next[0] + steps[from][1] * next[1]);
        }
        let ratio = |part: f64, whole: f64| {
            let ratio = if whole > 0.0 { part / whole } else { 0.5 };
            ratio.clamp(TINY, 1.0 - TINY)
        };
        let improved = Self {
            to_bad: ratio(moves[0][1], moves[0][0] + moves[0][1]),
            to_good: ratio(moves[1][0], moves[1][0] + moves[1][1]),
            loss: [ratio(lost[0], visits[0]), ratio(lost[1], visits[1])],
        };
        (improved, log_likelihood)
    }

    /// The same with the state of fewer losses first.
    pub(super) fn good_first(self) -> Self {
        if self.loss[0] <= self.loss[1] {
            return self;
        }
        Self {
            to_bad: self.to_good,
            to_good: self.to_bad,
            loss: [self.loss[1], self.loss[0]],
        }
    }
}
