// As fly.c.
package main

import (
	"bufio"
	"encoding/json"
	"fmt"
	"os"
	"strconv"
	"strings"

	"spikeserve.invalid/robot"
)

type object = map[string]any

func number(word string) float64 {
	value, err := strconv.ParseFloat(word, 64)
	if err != nil {
		panic(err)
	}
	return value
}

func open(words []string) (*robot.Robot, error) {
	maxAge := number(words[4])
	options := robot.Options{Servers: words[0], Policy: words[1], Session: &words[2], Period: number(words[3]), MaxAge: &maxAge}
	if words[5] != "-" {
		local := strings.Trim(words[5], "\"")
		options.LocalPolicy = &local
	}
	if words[6] != "-" {
		own := []float32{float32(number(words[6]))}
		options.Fallback = func(observation []float32) *robot.Action { return &robot.Action{Box: own} }
	}
	options.Transport = robot.Transport(number(words[7]))
	hold := int(number(words[8]))
	options.HoldBeats = &hold
	options.Log = func(line string) { fmt.Fprintln(os.Stderr, "robot:", line) }
	return robot.Open(options)
}

func beat(flown *robot.Robot, words []string) (any, error) {
	var numbers []float32
	for _, word := range words[4:] {
		numbers = append(numbers, float32(number(word)))
	}
	size := int(number(words[3]))
	var executed *robot.Action
	if len(numbers) > size {
		executed = &robot.Action{Box: numbers[size:], By: robot.Chooser(number(words[1])), OperatorID: strings.Trim(words[2], "-")}
	}
	step, err := flown.Step(numbers[:size], number(words[0]), executed)
	if err != nil {
		return nil, err
	}
	answer := object{"source": step.Source.String(), "age": step.Age, "beat": step.Number, "action": step.Action.Box}
	if step.Action.Box == nil {
		answer["action"] = step.Action.Discrete
	}
	return answer, nil
}

func summary(flown *robot.Robot, words []string) (any, error) {
	ended, err := flown.WaitSummary(uint64(number(words[0])), number(words[1]))
	if ended == nil {
		return object{}, err
	}
	return object{"steps": ended.Steps, "lost_steps": ended.LostSteps, "episode_return": ended.Return}, nil
}

func stats(flown *robot.Robot) any {
	s := flown.Stats()
	return object{"beats": s.Steps, "fresh": s.BySource[robot.Fresh], "held": s.BySource[robot.Held],
		"local": s.BySource[robot.Local], "safe": s.BySource[robot.Safe],
		"datagram_answers": s.DatagramAnswers, "sends_datagrams": s.SendsDatagrams, "reconnects": s.Reconnects, "reopened": s.Reopened,
		"dropped": s.Dropped, "lost_episodes": s.LostEpisodes, "unequal_returns": s.UnequalReturns, "invalid": s.Invalid,
		"failures": s.Failures, "has_local": s.HasLocal, "stays_safe": s.StaysSafe,
		"age_p50": s.AgeP50, "age_p99": s.AgeP99, "age_p999": s.AgeP999}
}

func main() {
	var flown *robot.Robot
	lines := bufio.NewScanner(os.Stdin)
	for lines.Scan() {
		words := strings.Split(lines.Text(), " ")
		var answer any = object{}
		var err error
		switch words[0] {
		case "open":
			flown, err = open(words[1:])
		case "beat":
			answer, err = beat(flown, words[1:])
		case "end":
			outcome := robot.Outcome{Reward: number(words[1]), Terminated: words[2] == "1"}
			answer = object{"episode": flown.EndEpisode(outcome)}
		case "summary":
			answer, err = summary(flown, words[1:])
		case "wait":
			answer = flown.WaitReady(number(words[1]))
		case "session":
			answer = flown.SessionID()
		case "stats":
			answer = stats(flown)
		case "close":
			flown.Close()
		}
		if failure, is := err.(*robot.Error); is {
			answer = object{"error": failure.Message, "code": failure.Code}
		}
		text, _ := json.Marshal(answer)
		fmt.Println(string(text))
	}
}
