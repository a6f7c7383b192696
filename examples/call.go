// Balances a pole with the decisions of a server, over HTTP with JSON: Go's standard library is enough.
// docs/guides/triton.md describes the requests.
//
// usage: go run examples/call.go [HOST:PORT of --http_listen]
package main

import (
	"bytes"
	"encoding/json"
	"fmt"
	"log"
	"math"
	"net/http"
	"os"
)

type values map[string]any

// Asks for the action at an observation. `start` begins a sequence; `end` ends it, and its action means nothing.
func act(server string, state []float64, reward float64, start, end bool) float64 {
	body, _ := json.Marshal(values{
		"inputs": []values{
			{"name": "observation", "shape": []int{4}, "datatype": "FP32", "data": state},
			{"name": "reward", "shape": []int{1}, "datatype": "FP32", "data": []float64{reward}}},
		"parameters": values{"sequence_id": "example", "sequence_start": start, "sequence_end": end}})
	response, err := http.Post("http://"+server+"/v2/models/cartpole/infer", "application/json", bytes.NewReader(body))
	if err != nil {
		log.Fatal(err)
	}
	defer response.Body.Close()
	var answer struct {
		Error   string
		Outputs []struct{ Data []float64 }
	}
	if err := json.NewDecoder(response.Body).Decode(&answer); err != nil || response.StatusCode != http.StatusOK {
		log.Fatal(response.Status, " ", answer.Error, err)
	}
	return answer.Outputs[0].Data[0] // the outputs are action, probabilities, return_to_go and spikes
}

func main() {
	server := append(os.Args[1:], "127.0.0.1:9464")[0]
	x, velocity, angle, turning := 0.01, -0.02, 0.03, 0.04
	steps := 0.0
	for ; steps < 500 && math.Abs(x) < 2.4 && math.Abs(angle) < 0.21; steps++ {
		action := act(server, []float64{x, velocity, angle, turning}, math.Min(steps, 1), steps == 0, false)
		sine, cosine := math.Sin(angle), math.Cos(angle) // Gymnasium's CartPole, by 20 ms
		force := 20*action - 10 + 0.05*turning*turning*sine
		angular := (9.8*sine - cosine*force/1.1) / (0.5 * (4.0/3 - 0.1*cosine*cosine/1.1))
		x, velocity = x+0.02*velocity, velocity+0.02*(force-0.05*angular*cosine)/1.1
		angle, turning = angle+0.02*turning, turning+0.02*angular
	}
	act(server, []float64{x, velocity, angle, turning}, 1, false, true)
	fmt.Printf("return %.0f\n", steps)
}
