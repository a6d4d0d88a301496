// Script of the page of gaponet app: dark where the system is dark; ?step=4 after the address opens step 4; a button
// "Next: 5 Identify" opens step 5.
{
  const given = new URLSearchParams(location.search);
  const systemIsDark = matchMedia("(prefers-color-scheme: dark)").matches;
  if (systemIsDark && !given.has("darkMode")) {
    location.search += location.search ? "&darkMode" : "?darkMode";
  }
  const openStep = (number) => {
    const tabs = [...document.querySelectorAll("[role=tab]")];
    const step = tabs.find((tab) => tab.innerText.trim()[0] === number);
    if (!step) return false;
    step.click();
    step.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter", bubbles: true }));
    return true;
  };
  const openGivenStep = () => {
    if (openStep(given.get("step"))) clearInterval(search);
  };
  const search = given.has("step") && setInterval(openGivenStep, 200);
  const next = /^Next: (\d)/;
  document.addEventListener("click", (event) => {
    const button = event.target.closest("button");
    const found = button && !button.disabled && button.innerText.trim().match(next);
    if (!found) return;
    openStep(found[1]);
    document.querySelector("[role=tablist]").scrollIntoView();
  });
}
