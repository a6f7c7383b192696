//! spikeserve_robot.h. Arrays stand for members of one type that follow each other.
use std::os::raw::{c_char, c_int, c_void};

#[repr(C)]
pub struct Error { pub code: i32, pub message: [c_char; 508] }

#[repr(C)]
pub struct Action {
    pub discrete: i64,
    pub continuous: *const f32, pub size: usize,
    pub source: i32, pub age: f64, pub step: u64,
    pub by: i32, pub operator_id: *const c_char,
}

pub type Fallback = unsafe extern "C" fn(*mut c_void, *const f32, usize, *mut Action) -> c_int;
pub type Log = unsafe extern "C" fn(*mut c_void, *const c_char);

#[repr(C)]
pub struct Options {
    pub size: usize,
    pub texts: [*const c_char; 8], // servers to token
    pub times: [f64; 5],           // patience to close_timeout
    pub counts: [i32; 6],          // hold_beats to redundancy
    pub tls: i32,
    pub neutral: *const Action,
    pub fallback: Option<Fallback>, pub log: Option<Log>,
    pub context: *mut c_void,
}

#[repr(C)]
pub struct Outcome { pub reward: f64, pub terminated_truncated: [i32; 2], pub executed: *const Action }

/// An episode that the server has wholly.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Summary { pub steps: i64, pub lost_steps: i64, pub episode_return: f64 }

/// What a robot has done. spikeserve_robot.h says what each figure is.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default)]
pub struct Stats {
    pub(crate) size: usize,
    pub steps: u64, pub by_source: [u64; 4], pub entries: [u64; 4],
    pub stale: u64, pub late_answers: u64, pub cancelled_calls: u64, pub datagram_answers: u64,
    pub reconnects: u64, pub reopened: u64,
    pub dropped: u64, pub lost_episodes: u64, pub unequal_returns: u64,
    pub invalid: u64, pub invalid_observations: u64, pub failures: u64,
    pub longest_gap: f64, pub age_p50: f64, pub age_p99: f64, pub age_p999: f64,
    pub has_local: i32, pub local_head_is_copy: i32, pub sends_datagrams: i32,
    pub stays_safe: i32, // 1: the server keeps the robot at its safe action
}

pub enum Robot {}

#[link(name = "spikeserve_robot")]
extern "C" {
    pub fn spikeserve_robot_options_init(options: *mut Options, size: usize);
    pub fn spikeserve_robot_open(options: *const Options, robot: *mut *mut Robot, error: *mut Error) -> c_int;
    pub fn spikeserve_robot_step(robot: *mut Robot, observation: *const f32, size: usize, reward: f64,
        executed: *const Action, action: *mut Action, error: *mut Error) -> c_int;
    pub fn spikeserve_robot_wait_ready(robot: *mut Robot, timeout: f64) -> c_int;
    pub fn spikeserve_robot_end_episode(robot: *mut Robot, outcome: *const Outcome) -> u64;
    pub fn spikeserve_robot_wait_summary(robot: *mut Robot, episode: u64, timeout: f64, summary: *mut Summary,
        error: *mut Error) -> c_int;
    pub fn spikeserve_robot_stats(robot: *const Robot, stats: *mut Stats);
    pub fn spikeserve_robot_session_id(robot: *const Robot, id: *mut c_char, size: usize) -> usize;
    pub fn spikeserve_robot_close(robot: *mut Robot);
}
