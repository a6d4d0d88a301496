// Script of the page of gaponet app: dark where the system is dark; ?step=4 after the address opens step 4.
{
  const given = new URLSearchParams(location.search);
  const systemIsDark = matchMedia("(prefers-color-scheme: dark)").matches;
  if (systemIsDark && !given.has("darkMode")) {
    location.search += location.search ? "&darkMode" : "?darkMode";
  }
  const openStep = () => {
    const tabs = [...document.querySelectorAll("[role=tab]")];
    const step = tabs.find((tab) => tab.innerText.trim()[0] === given.get("step"));
    if (!step) return;
    clearInterval(search);
    step.click();
    step.dispatchEvent(new KeyboardEvent("keydown", { key: "Enter", bubbles: true }));
  };
  const search = given.has("step") && setInterval(openStep, 200);
}
