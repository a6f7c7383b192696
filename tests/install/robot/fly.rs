//! As fly.c.
use spikeserve_robot::{Action, Chooser, Error, Executed, Options, Outcome, Robot, Transport};
use std::ffi::CString;
use std::io::BufRead;

fn failure(error: Error) -> String {
    format!(r#"{{"error": {:?}, "code": {}}}"#, error.message, error.code)
}

fn open(words: &[&str]) -> Result<Robot, Error> {
    let local = match words[5] {
        "-" => None,
        "\"\"" => Some(String::new()),
        path => Some(path.to_string()),
    };
    let mut options = Options {
        servers: words[0].into(),
        policy: words[1].into(),
        session: Some(words[2].into()),
        period: words[3].parse().unwrap(),
        max_age: words[4].parse().ok(),
        hold_beats: words[8].parse().ok(),
        local_policy: local,
        transport: [Transport::Auto, Transport::Stream, Transport::Datagram][words[7].parse::<usize>().unwrap()],
        log: Some(Box::new(|line| eprintln!("robot: {line}"))),
        ..Options::default()
    };
    if let Ok(own) = words[6].parse::<f32>() {
        options.fallback = Some(Box::new(move |observation| (!observation.is_empty()).then(|| vec![own])));
    }
    Robot::open(options)
}

fn beat(robot: &mut Robot, words: &[&str]) -> Result<String, Error> {
    let by = if words[1] == "2" { Chooser::Operator } else { Chooser::Unknown };
    let operator = CString::new(words[2].trim_matches('-')).unwrap();
    let numbers: Vec<f32> = words[4..].iter().map(|word| word.parse().unwrap()).collect();
    let (observation, executed) = numbers.split_at(words[3].parse().unwrap());
    let executed =
        (!executed.is_empty()).then(|| Executed { action: Action::Box(executed), by, operator_id: &operator });
    let step = robot.step(observation, words[0].parse().unwrap(), executed)?;
    let action = match step.action {
        Action::Discrete(index) => index.to_string(),
        Action::Box(numbers) => format!("{numbers:?}"),
    };
    let source = format!("{:?}", step.source).to_lowercase();
    Ok(format!(r#"{{"source": "{source}", "age": {:?}, "beat": {}, "action": {action}}}"#, step.age, step.number))
}

fn summary(robot: &mut Robot, words: &[&str]) -> Result<String, Error> {
    let ended = robot.wait_summary(words[0].parse().unwrap(), words[1].parse().unwrap())?;
    Ok(ended.map_or("{}".into(), |ended| {
        let (steps, lost) = (ended.steps, ended.lost_steps);
        format!(r#"{{"steps": {steps}, "lost_steps": {lost}, "episode_return": {:?}}}"#, ended.episode_return)
    }))
}

fn stats(robot: &Robot) -> String {
    let s = robot.stats();
    let [fresh, held, local, safe] = s.by_source;
    let counts = [
        ("beats", s.steps), ("fresh", fresh), ("held", held), ("local", local), ("safe", safe),
        ("datagram_answers", s.datagram_answers), ("sends_datagrams", s.sends_datagrams as u64),
        ("reconnects", s.reconnects), ("reopened", s.reopened), ("dropped", s.dropped), ("lost_episodes", s.lost_episodes),
        ("unequal_returns", s.unequal_returns), ("invalid", s.invalid), ("failures", s.failures),
        ("has_local", s.has_local as u64), ("stays_safe", s.stays_safe as u64),
    ];
    let counts: String = counts.iter().map(|(name, count)| format!("{name:?}: {count}, ")).collect();
    format!(r#"{{{counts}"age_p50": {:?}, "age_p99": {:?}, "age_p999": {:?}}}"#, s.age_p50, s.age_p99, s.age_p999)
}

fn main() {
    let mut robot = None;
    for line in std::io::stdin().lock().lines() {
        let line = line.unwrap();
        let (what, words) = line.split_once(' ').unwrap_or((&line, ""));
        let words: Vec<&str> = words.split(' ').collect();
        let answer = match (what, robot.as_mut()) {
            ("open", _) => open(&words).map(|opened| {
                robot = Some(opened);
                "{}".into()
            }),
            ("beat", Some(robot)) => beat(robot, &words),
            ("end", Some(robot)) => {
                let outcome = Outcome { reward: words[0].parse().unwrap(), terminated: words[1] == "1", ..Outcome::default() };
                Ok(format!(r#"{{"episode": {}}}"#, robot.end_episode(outcome)))
            }
            ("summary", Some(robot)) => summary(robot, &words),
            ("wait", Some(robot)) => Ok(robot.wait_ready(words[0].parse().unwrap()).to_string()),
            ("session", Some(robot)) => Ok(format!("{:?}", robot.session_id())),
            ("stats", Some(robot)) => Ok(stats(robot)),
            _ => {
                robot = None;
                Ok("{}".into())
            }
        };
        println!("{}", answer.unwrap_or_else(failure));
    }
}
